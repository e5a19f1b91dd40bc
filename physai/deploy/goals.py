"""Goals from outside: which are taken, and which are not."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from physai.deploy.joints import to_floats
from physai.deploy.metadata import Metadata
from physai.signals import Quantity, Signal

_LENGTH = 0.1  # by which that of a quaternion may differ from 1: digits that were left out, not a forgotten orientation


@dataclass(frozen=True)
class Goal:
    """What the robot shall do.

    Attributes:
        value: Numbers, in the order of the policy's goal signal, or one for each of ``names``.
        frame: Name of the frame of a goal that is a place; else empty.
        names: What the numbers belong to, in any order, such as joints; empty where their order says it.
    """

    value: Sequence[float]
    frame: str = ""
    names: Sequence[str] = ()


class GoalError(Exception):
    """A goal that cannot be taken: ``kind`` for counting, and a line for people."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(f"goal rejected: {message}")
        self.kind = kind


def accept(
    goal: Goal, metadata: Metadata, project: bool, inside: Callable[[np.ndarray], str | None] = lambda _: None
) -> tuple[np.ndarray, bool]:
    """Return the goal's numbers in the signal's order, and whether they were moved into the region of goals.

    Args:
        goal: What came.
        metadata: What the policy takes.
        project: Whether a goal out of reach may be moved.
        inside: Names what a point in the base frame [3], m, lies in.

    Raises:
        GoalError: If it is not made of finite numbers, in another frame, out of reach, or in something.
    """
    signal = metadata.goal
    value = to_floats(goal.value) if isinstance(goal, Goal) else None
    if value is None:
        raise GoalError("malformed", "it is not made of numbers")
    if len(names := _names(goal)):
        value = _in_order(value, names, signal)
    if value.shape != signal.shape:
        raise GoalError("malformed", f"it has the shape {list(value.shape)}, not {list(signal.shape)}")
    if not np.isfinite(value).all():
        raise GoalError("not finite", "it is not finite")
    if not isinstance(goal.frame, str):
        raise GoalError("malformed", "its frame is no name")
    if goal.frame != signal.frame and signal.frame:
        raise GoalError("wrong frame", f"frame '{goal.frame}' is not '{signal.frame}'")
    if signal.quantity is Quantity.POSE:
        value = _normalized(value)
    projected = (
        None if (contained := metadata.region.contains(value)) or not project else metadata.region.project(value)
    )
    if not contained and projected is None:
        raise GoalError("unreachable", metadata.region.describe(value))
    taken = value if projected is None else projected
    in_space = signal.quantity in (Quantity.POSITION, Quantity.POSE) and signal.size > 2
    if in_space and (name := inside(taken[:3])) is not None:
        raise GoalError("in something", f"it lies in '{name}'")
    return taken, not contained


def _normalized(pose: np.ndarray) -> np.ndarray:
    """The same pose with a quaternion of length 1, of which the last number is not negative."""
    length = float(np.linalg.norm(pose[3:]))
    if not abs(length - 1.0) < _LENGTH:
        raise GoalError("not a rotation", f"its quaternion has the length {length:.3f}, not 1")
    return np.concatenate([pose[:3], pose[3:] / (length if pose[6] >= 0 else -length)])


def _names(goal: Goal) -> tuple[str, ...]:
    try:
        names = tuple(goal.names)
    except TypeError:
        names = (None,)  # type: ignore[assignment]
    if not all(isinstance(name, str) for name in names):
        raise GoalError("malformed", "its names are none")
    return names


def _in_order(value: np.ndarray, names: tuple[str, ...], signal: Signal) -> np.ndarray:
    if value.shape != (len(names),):
        raise GoalError("malformed", f"{len(names)} names, but values of the shape {list(value.shape)}")
    if sorted(names) != sorted(signal.labels):
        raise GoalError("malformed", f"it is for {list(names)}, not {list(signal.labels)}")
    return value[[names.index(label) for label in signal.labels]]
