"""The ``collision`` of a robot's YAML: capsules on its links, and which of them can meet."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from urdf_parser_py.urdf import Joint, Robot

from physai.collision import Capsule, CollisionModel
from physai.config import Config, PositiveFloat, nearest
from physai.errors import UserError
from physai.robots.chain import carried, motions

PointConfig = Annotated[list[float], Field(min_length=3, max_length=3)]


class CapsuleConfig(Config):
    """All points within ``radius``, m, of the segment from ``start`` to ``end``, m, in the frame of the link."""

    link: str
    start: PointConfig
    end: PointConfig
    radius: PositiveFloat


class CollisionConfig(Config):
    """``pairs`` are of the places of two capsules in the list, from 0 on."""

    capsules: Annotated[list[CapsuleConfig], Field(min_length=1)]
    pairs: list[Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]]


def model(
    path: Path, robot: Robot, chain: Sequence[Joint], driven: Sequence[str], config: CollisionConfig
) -> CollisionModel:
    """Put the capsules on the bodies that carry the links.

    Pairs of capsules that no driven joint moves against each other are left out: a robot some of whose joints are held
    can so have the capsules of one whose joints are all driven.

    Args:
        path: Of the URDF, for errors.
        robot: Its links and joints.
        chain: Joints from the base to the end effector.
        driven: Names of the joints that move.
        config: The capsules.

    Raises:
        UserError: If a capsule's link or a pair's capsule does not exist, or the URDF has joints in a loop.
    """
    bodies = carried(robot.joints, chain[0].parent, driven)
    capsules = []
    for row, given in enumerate(config.capsules):
        if given.link not in bodies:
            raise UserError(
                f"collision.capsules.{row}.link: {path} has no link '{given.link}'{nearest(given.link, bodies)}"
            )
        body, frame = bodies[given.link]
        ends = np.array([given.start, given.end]) @ frame[:3, :3].T + frame[:3, 3]
        start, end = (tuple(point) for point in ends.tolist())
        capsules.append(Capsule(given.link, body, start, end, given.radius))
    for row, pair in enumerate(config.pairs):
        if max(pair) >= len(capsules):
            raise UserError(f"collision.pairs.{row}: {pair} must be places among the {len(capsules)} capsules, from 0")
    apart = [(a, b) for a, b in config.pairs if capsules[a].body != capsules[b].body]
    try:
        return CollisionModel(motions(chain, chain[0].parent, driven), tuple(capsules), tuple(apart))
    except ValueError as error:
        raise UserError(f"collision: {error}") from error
