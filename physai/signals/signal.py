"""A signal: its name, shape, unit, bounds, frame, and what its numbers stand for."""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np


class Quantity(str, Enum):
    """What the numbers of a signal are; a message type on a robot's side follows from it."""

    JOINT_POSITION = "joint_position"  # rad, one a joint
    JOINT_VELOCITY = "joint_velocity"  # rad/s, one a joint
    POSITION = "position"  # a point in a frame, m
    POSE = "pose"  # a point in a frame, m, then a quaternion x, y, z, w; its opposite is the same pose
    ANGULAR_VELOCITY = "angular_velocity"  # about the axes of a frame, rad/s
    DIRECTION = "direction"  # a vector of length 1 in a frame
    TWIST = "twist"  # x and y velocity, m/s, and yaw rate, rad/s, in a frame
    ACTION = "action"  # what a policy asked for, in [-1, 1], one a joint
    TIME = "time"  # s
    MEMORY = "memory"  # what a policy remembers
    VIEW = "view"  # what a policy sees, of more than one quantity

    @property
    def unit(self) -> str:
        """Its SI unit; empty where the numbers have none, or not the same one."""
        return _UNITS.get(self, "")


_UNITS = {
    Quantity.JOINT_POSITION: "rad",
    Quantity.JOINT_VELOCITY: "rad/s",
    Quantity.POSITION: "m",
    Quantity.ANGULAR_VELOCITY: "rad/s",
    Quantity.TIME: "s",
}


@dataclass(frozen=True)
class Signal:
    """What a robot senses, a task asks, or a policy answers, of one robot.

    Attributes:
        name: The key under which it travels.
        quantity: What its numbers are.
        shape: Of one robot's value; a batch has the robots as a further, first axis.
        low: Smallest values, one for each number in row-major order; empty where there is no bound.
        high: Largest values, likewise.
        labels: What each number belongs to, such as joints or axes; empty where nothing needs to be told apart.
        frame: The link in whose frame a position is given.
    """

    name: str
    quantity: Quantity
    shape: tuple[int, ...]
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    labels: tuple[str, ...] = ()
    frame: str = ""

    def __post_init__(self) -> None:
        for what, values in (("low", self.low), ("high", self.high), ("labels", self.labels)):
            if len(values) not in (0, self.size):
                raise ValueError(f"signal '{self.name}': {what} has {len(values)} values for {self.size} numbers")

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return math.prod(self.shape)

    @property
    def unit(self) -> str:
        """SI unit of its numbers."""
        return self.quantity.unit

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest values, of its shape; infinite where there is no bound."""
        low = np.array(self.low or [-math.inf] * self.size, dtype=np.float64)
        high = np.array(self.high or [math.inf] * self.size, dtype=np.float64)
        return low.reshape(self.shape), high.reshape(self.shape)

    @classmethod
    def of_joints(
        cls, name: str, quantity: Quantity, joints: tuple[str, ...], low: np.ndarray, high: np.ndarray
    ) -> "Signal":
        """Declare one number a joint, between ``low`` and ``high``, [n] each."""
        return cls(name, quantity, (len(joints),), tuple(low.tolist()), tuple(high.tolist()), joints)


@dataclass(frozen=True)
class Tolerance:
    """How far from a goal is near enough, in one unit.

    Attributes:
        name: What is measured, such as ``distance``.
        unit: Its SI unit.
        value: The largest error that counts as reached.
    """

    name: str
    unit: str
    value: float
