"""What a robot is, read once from ``conf/robot/*.yaml`` and the URDF that it names."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from urdf_parser_py.urdf import Joint, JointLimit, Robot

from physai.collision import CollisionModel, Motions
from physai.config import Config, EachNonNegative, EachPositive, PositiveFloat, nearest, of_each
from physai.errors import UserError
from physai.robots import bodies, collision, urdf
from physai.robots.bodies import Body, InertialConfig
from physai.robots.chain import carried, motions
from physai.robots.collision import CollisionConfig
from physai.robots.floating import FloatingBase, FloatingConfig, Servo, ServoConfig
from physai.signals import Quantity, Signal


class LimitsConfig(Config):
    """Of each joint: ``position``, lowest and highest, rad; ``velocity``, rad/s; ``effort``, N·m."""

    position: list[Annotated[list[float], Field(min_length=2, max_length=2)]]
    velocity: EachPositive
    effort: EachPositive


class RobotConfig(Config):
    """One file of ``conf/robot``.

    ``command`` says what drives the joints, and ``command_limit`` what an action of 1 means to each: with ``action:
    speed`` how fast it moves, rad/s, with ``action: offset`` how far from home it goes, rad. Joints that take positions
    either close in on them at ``position_gain``, 1/s, or are the springs of ``servo``. What follows stands in the place
    of what the URDF says, or does not say: ``limits``, ``damping``, N·m·s/rad, ``friction``, N·m, and ``armature``,
    kg·m², of joints (what rotors add to the inertia that they feel), and ``inertials`` of links by name. One number may
    stand for all joints. ``gravity`` is in the base's frame, m/s²: it says how the base is mounted. Without
    ``collision`` nobody asks whether the robot touches itself. ``floating`` is of a base that nothing holds; a robot
    that has none needs an ``end_effector``.
    """

    name: str
    urdf: str
    joints: list[str] = Field(min_length=1)
    end_effector: str | None
    home: list[float]
    command: Literal["joint_velocity", "joint_position"]
    action: Literal["speed", "offset"]
    command_limit: EachPositive
    position_gain: PositiveFloat
    servo: ServoConfig | None
    floating: FloatingConfig | None
    limits: LimitsConfig | None
    damping: EachNonNegative | None
    friction: EachNonNegative | None
    armature: EachNonNegative
    gravity: list[float] = Field(min_length=3, max_length=3)
    inertials: dict[str, InertialConfig]
    collision: CollisionConfig | None


@dataclass(frozen=True)
class RobotSpec:
    """A robot's URDF, its controlled joints, and their limits; arrays follow the order of ``joints``.

    Attributes:
        name: The robot's name.
        urdf: Path of the URDF file.
        joints: Names of the n controlled joints.
        base: Name of the link in whose frame positions are given.
        end_effector: Name of the link that reaches; None where none does.
        home: Rest pose, rad, [n].
        position_limit: Lower and upper limit, rad, [n, 2]; infinite for continuous joints.
        velocity_limit: rad/s, [n].
        effort_limit: N·m, [n].
        command: What drives the joints: their velocities or their positions.
        offset: Whether an action is how far from home a joint shall be; else it is how fast it shall move.
        command_limit: What an action of 1 means to each joint, rad/s, or rad from home, [n].
        position_gain: Of joints that take positions, 1/s: they want to move at this times the distance to go.
        servo: Of joints that are driven as springs; None of others.
        floating: What there is to know of a base that nothing holds; None of one that is fixed.
        damping: N·m·s/rad, [n].
        friction: Coulomb friction, N·m, [n].
        armature: Inertia of the rotors, as their joints feel it through the gears, kg·m², [n].
        gravity: In the base's frame, m/s², [3].
        linkage: Joints from the base to the end effector, in order; all joints of a robot that has none.
        bodies: What engines simulate, from the base on.
        moving_links: Bodies with mass that move, by the name of their first link.
        link_mass: Their masses, kg.
        collision: The shapes of its links and which of them can meet; None where nobody has told.
        doubtful: What its description says that can hardly be true, in words.
    """

    name: str
    urdf: Path
    joints: tuple[str, ...]
    base: str
    end_effector: str | None
    home: np.ndarray
    position_limit: np.ndarray
    velocity_limit: np.ndarray
    effort_limit: np.ndarray
    command: Quantity
    offset: bool
    command_limit: np.ndarray
    position_gain: float
    servo: Servo | None
    floating: FloatingBase | None
    damping: np.ndarray
    friction: np.ndarray
    armature: np.ndarray
    gravity: np.ndarray
    linkage: tuple[Joint, ...]
    bodies: tuple[Body, ...]
    moving_links: tuple[str, ...]
    link_mass: np.ndarray
    collision: CollisionModel | None
    doubtful: tuple[str, ...]

    def need_fixed_base(self, what: str) -> None:
        """Refuse by name what cannot be done with a robot whose base floats, with a UserError."""
        if self.floating is not None:
            raise UserError(f"the base of robot '{self.name}' floats: {what} such a robot is not possible yet")

    @property
    def carrier(self) -> str:
        """Which link a payload is on: the end effector, or else the base."""
        return self.end_effector or self.base

    @property
    def continuous(self) -> np.ndarray:
        """Which joints turn without end, [n]."""
        return np.isinf(self.position_limit[:, 0])

    def sample(self, rows: int, generator: np.random.Generator) -> np.ndarray:
        """Draw joint positions [rows, n], rad, uniform within the limits; of a joint without any, a full turn."""
        lower, upper = np.where(self.continuous[:, np.newaxis], [-np.pi, np.pi], self.position_limit).T
        return generator.uniform(lower, upper, (rows, len(self.joints)))

    @property
    def motions(self) -> Motions:
        """What each controlled joint moves; the others are held at zero."""
        return motions(self.linkage, self.base, self.joints)

    @property
    def tip(self) -> np.ndarray | None:
        """Frame of the end effector in that of the body which the last joint moves, 4 x 4; None where none is."""
        if self.end_effector is None:
            return None
        return carried(self.linkage, self.base, self.joints)[self.end_effector][1]

    @property
    def joint_position(self) -> Signal:
        """What its encoders tell."""
        return Signal.of_joints("joint_position", Quantity.JOINT_POSITION, self.joints, *self.position_limit.T)

    @property
    def joint_velocity(self) -> Signal:
        """How fast its joints move."""
        limit = self.velocity_limit
        return Signal.of_joints("joint_velocity", Quantity.JOINT_VELOCITY, self.joints, -limit, limit)

    @property
    def joint_command(self) -> Signal:
        """What it is driven by."""
        limit, (lower, upper) = self.command_limit, self.position_limit.T
        if self.offset:
            lower, upper = np.maximum(lower, self.home - limit), np.minimum(upper, self.home + limit)
        bounds = (-limit, limit) if self.command is Quantity.JOINT_VELOCITY else (lower, upper)
        return Signal.of_joints(f"{self.command.value}_command", self.command, self.joints, *bounds)

    @classmethod
    def from_config(cls, config: RobotConfig) -> "RobotSpec":
        """Read the URDF and check that it has what the config names.

        Raises:
            UserError: If the URDF is missing or broken, or lacks a joint, link or limit; the line names it.
        """
        path = urdf.resolve(config.urdf)
        robot = urdf.load(path)
        links = {link.name: link for link in robot.links}
        by_child = {joint.child: joint for joint in robot.joints}

        tip = config.end_effector
        if tip is None and config.floating is None:
            raise UserError(f"robot '{config.name}': a robot whose base is fixed needs an end_effector")
        if tip is not None and tip not in links:
            raise UserError(f"{path}: no link '{tip}'{nearest(tip, links)}")
        chain = _chain(path, tip, by_child) if tip else []
        base = chain[0].parent if chain else next(name for name in links if name not in by_child)
        by_name = {joint.name: joint for joint in robot.joints}
        for name in config.joints:
            if name not in by_name:
                raise UserError(f"{path}: no joint '{name}'{nearest(name, by_name)}")
        for name in {name for name in config.joints if config.joints.count(name) > 1}:
            raise UserError(f"{path}: joint '{name}' is named twice in the robot's joints")
        on_chain = [joint.name for joint in chain if joint.name in config.joints]
        if tip and on_chain != list(config.joints):
            raise UserError(
                f"{path}: the joints must lie on the way from the base to '{tip}', in that order: "
                f"{on_chain}, not {list(config.joints)}"
            )
        joints = [by_name[name] for name in config.joints]
        if config.limits is not None:
            _give_limits(joints, config.limits, config.name)
        for joint in joints:
            _check_driven(path, joint)
        if len(config.home) != len(joints):
            raise UserError(f"robot '{config.name}': home has {len(config.home)} values for {len(joints)} joints")
        told = {key: getattr(config, key) for key in ("command_limit", "damping", "friction", "armature")}
        per_joint = {
            key: of_each(values, len(joints), f"robot '{config.name}': {key}")
            for key, values in told.items()
            if values is not None
        }
        for joint, speed in zip(joints, per_joint["command_limit"], strict=True):
            if config.action == "speed" and speed > joint.limit.velocity:
                raise UserError(
                    f"robot '{config.name}': command_limit: {speed:g} rad/s is beyond the limit of '{joint.name}', "
                    f"{joint.limit.velocity:g} rad/s"
                )

        driven = tuple(config.joints)
        shapes = None
        if config.collision is not None:
            if tip is None:
                raise UserError(f"robot '{config.name}': collision: capsules need an end_effector")
            shapes = collision.model(path, robot, chain, driven, config.collision)
        if config.action == "offset" and config.command != "joint_position":
            raise UserError(f"robot '{config.name}': action: offset needs command: joint_position")
        servo = floating = None
        if config.servo is not None:
            servo = Servo.from_config(config.servo, config.name, config.command, len(joints))
        below = list(links)
        if config.floating is None:
            below = _links_below(config.joints[0], robot.joints, by_name)
        together = bodies.merge(path, robot, driven, tip, config.inertials, floats=config.floating is not None)
        if config.floating is not None:
            floating = FloatingBase.from_config(config.floating, config.name, path, robot, base, together)
            if servo is None:
                raise UserError(f"robot '{config.name}': a floating base needs joints that are springs: give a servo")
            motions(robot.joints, base, driven)  # checks their order
        moving = [body for body in together if body.name in below and body.mass]
        for body in together:
            if body.joint is not None and body.joint.name in driven and not body.mass:
                raise UserError(f"{path}: link '{body.name}' moves but has no <inertial> with a mass")
        return cls(
            name=config.name,
            urdf=path,
            joints=tuple(config.joints),
            base=base,
            end_effector=tip,
            home=np.array(config.home, dtype=np.float64),
            position_limit=np.array([_position_limit(joint) for joint in joints]),
            velocity_limit=np.array([joint.limit.velocity for joint in joints], dtype=np.float64),
            effort_limit=np.array([joint.limit.effort for joint in joints], dtype=np.float64),
            command=Quantity(config.command),
            offset=config.action == "offset",
            command_limit=per_joint["command_limit"],
            position_gain=config.position_gain,
            servo=servo,
            floating=floating,
            damping=per_joint.get("damping", _dynamics(joints, "damping")),
            friction=per_joint.get("friction", _dynamics(joints, "friction")),
            armature=per_joint["armature"],
            gravity=np.array(config.gravity, dtype=np.float64),
            linkage=tuple(chain if tip else robot.joints),
            bodies=together,
            moving_links=tuple(body.name for body in moving),
            link_mass=np.array([body.mass for body in moving], dtype=np.float64),
            collision=shapes,
            doubtful=_doubtful(robot, below, config),
        )


def _chain(path: Path, link: str, by_child: dict[str, Joint]) -> list[Joint]:
    chain: list[Joint] = []
    while link in by_child:
        joint = by_child[link]
        if joint in chain:
            raise UserError(f"{path}: joint '{joint.name}' is part of a loop")
        chain.insert(0, joint)
        link = joint.parent
    return chain


def _links_below(joint: str, joints: list[Joint], by_name: dict[str, Joint]) -> list[str]:
    below = [by_name[joint].child]
    for link in below:
        below += [other.child for other in joints if other.parent == link]
    return below


def _give_limits(joints: list[Joint], limits: LimitsConfig, name: str) -> None:
    where, count = f"robot '{name}': limits.", len(joints)
    if len(limits.position) != count:
        raise UserError(f"{where}position has {len(limits.position)} values for {count} joints")
    velocity, effort = (of_each(getattr(limits, key), count, where + key) for key in ("velocity", "effort"))
    for row, (joint, (lower, upper)) in enumerate(zip(joints, limits.position, strict=True)):
        joint.limit = JointLimit(float(effort[row]), float(velocity[row]), lower, upper)
        if joint.type == "continuous":
            joint.type = "revolute"


def _check_driven(path: Path, joint: Joint) -> None:
    where = f"{path}: joint '{joint.name}'"
    if joint.type not in ("revolute", "continuous"):
        raise UserError(f"{where} is {joint.type}: only revolute and continuous joints can be driven")
    if joint.axis is not None and not any(joint.axis):
        raise UserError(f"{where}: its <axis> is zero")
    if joint.limit is None:
        raise UserError(f"{where} has no <limit>: effort and velocity are needed; the robot's YAML may give 'limits'")
    if not (joint.limit.effort or 0) > 0 or not (joint.limit.velocity or 0) > 0:
        raise UserError(f"{where}: the effort and velocity of its <limit> must be positive")
    lower, upper = _position_limit(joint)
    if lower >= upper:
        raise UserError(f"{where}: its lower limit {lower:g} is not below its upper limit {upper:g}")


def _position_limit(joint: Joint) -> tuple[float, float]:
    if joint.type == "continuous":
        return -np.inf, np.inf
    return float(joint.limit.lower or 0), float(joint.limit.upper or 0)


def _dynamics(joints: list[Joint], key: str) -> np.ndarray:
    return np.array([float(getattr(joint.dynamics, key, None) or 0) for joint in joints], dtype=np.float64)


def _doubtful(robot: Robot, moving: list[str], config: RobotConfig) -> tuple[str, ...]:
    dummies = bodies.dummies(robot, moving, config.inertials)
    if not dummies:
        return ()
    return (
        f"the inertia of {', '.join(dummies)} is surely a dummy: it is the same for links of other masses; "
        "give it under 'inertials' in the robot's YAML",
    )
