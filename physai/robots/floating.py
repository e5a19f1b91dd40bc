"""A base that nothing holds, what of a robot touches the floor, and joints that are driven as springs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from urdf_parser_py.urdf import Robot

from physai.config import Config, EachNonNegative, EachPositive, PositiveFloat, nearest, of_each
from physai.errors import UserError
from physai.robots.bodies import Body
from physai.robots.chain import welded


class SphereConfig(Config):
    """All points within ``radius``, m, of ``center``, m, in the frame of the link."""

    link: str
    center: Annotated[list[float], Field(min_length=3, max_length=3)]
    radius: PositiveFloat


class FloatingConfig(Config):
    """A base that nothing holds, above a floor.

    ``height`` is that of its frame while the robot stands at home, m; ``spheres`` are all of the robot that can touch
    the floor, whose ``friction`` is a coefficient; ``contact_time`` says how soft feet and floor are: the time constant
    with which what has sunk in is pushed out again, s; ``feet`` are the links that it stands on.
    """

    height: PositiveFloat
    friction: PositiveFloat
    contact_time: PositiveFloat
    feet: Annotated[list[str], Field(min_length=1)]
    spheres: Annotated[list[SphereConfig], Field(min_length=1)]


class ServoConfig(Config):
    """``stiffness``, N·m/rad, and ``damping``, N·m·s/rad, one value a joint, or one for all."""

    stiffness: EachPositive
    damping: EachNonNegative


@dataclass(frozen=True)
class Sphere:
    """What can touch the floor.

    Attributes:
        link: Of which it is a part.
        body: What carries it, by the name of its first link.
        center: In the body's frame, m.
        radius: m.
    """

    link: str
    body: str
    center: tuple[float, ...]
    radius: float


@dataclass(frozen=True)
class FloatingBase:
    """What there is to know of a robot whose base nothing holds.

    Attributes:
        height: Of the base above the floor at home, m.
        friction: Between robot and floor.
        contact_time: Time constant of a contact with the floor, s.
        spheres: All that can touch the floor.
        links: Those that can, in the order of :attr:`physai.physics.RobotState.contact`.
        feet: The places of the feet among them.
    """

    height: float
    friction: float
    contact_time: float
    spheres: tuple[Sphere, ...]
    links: tuple[str, ...]
    feet: tuple[int, ...]

    @property
    def foot_links(self) -> tuple[str, ...]:
        """Names of the links that it stands on."""
        return tuple(self.links[foot] for foot in self.feet)

    @classmethod
    def from_config(
        cls, config: FloatingConfig, name: str, path: Path, robot: Robot, base: str, bodies: Sequence[Body]
    ) -> "FloatingBase":
        """Put the spheres on the bodies that carry their links.

        Raises:
            UserError: If a sphere's link does not exist, or a foot has no sphere.
        """
        carriers = welded(robot.joints, base, [body.name for body in bodies])
        spheres = []
        for row, given in enumerate(config.spheres):
            if given.link not in carriers:
                missing = f"{path} has no link '{given.link}'{nearest(given.link, carriers)}"
                raise UserError(f"robot '{name}': floating.spheres.{row}.link: {missing}")
            body, frame = carriers[given.link]
            center = frame[:3, :3] @ np.array(given.center) + frame[:3, 3]
            spheres.append(Sphere(given.link, body, tuple(center.tolist()), given.radius))
        links = tuple(dict.fromkeys(sphere.link for sphere in spheres))
        for foot in config.feet:
            if foot not in links:
                raise UserError(f"robot '{name}': floating.feet: '{foot}' has no sphere{nearest(foot, links)}")
        feet = tuple(links.index(foot) for foot in config.feet)
        return cls(config.height, config.friction, config.contact_time, tuple(spheres), links, feet)


@dataclass(frozen=True)
class Servo:
    """Joints as springs: the effort is stiffness times the way to go, minus damping times the velocity.

    Attributes:
        stiffness: N·m/rad, [n].
        damping: N·m·s/rad, [n].
    """

    stiffness: np.ndarray
    damping: np.ndarray

    @classmethod
    def from_config(cls, config: ServoConfig, name: str, command: str, joints: int) -> "Servo":
        """Check that there is a value for each joint, and that they take positions; raises a UserError if not."""
        if command != "joint_position":
            raise UserError(f"robot '{name}': a servo needs command: joint_position")
        values = vars(config).items()
        return cls(**{key: of_each(each, joints, f"robot '{name}': servo.{key}") for key, each in values})
