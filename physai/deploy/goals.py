"""Goals from outside: which are taken, and which are not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physai.deploy.joints import to_floats
from physai.deploy.metadata import Metadata
from physai.signals import Signal


@dataclass(frozen=True)
class Goal:
    """Where the robot shall go.

    Attributes:
        value: Its numbers, in the unit and order of the policy's goal.
        frame: Name of the frame of a position; a goal of joints has none.
        names: What each number is for, such as a joint; with names, the order is free. Empty: in the policy's order.
    """

    value: Sequence[float]
    frame: str = ""
    names: Sequence[str] = ()


class GoalError(Exception):
    """A goal that cannot be taken: ``kind`` for counting, and a line for people."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(f"goal rejected: {message}")
        self.kind = kind


def accept(goal: Goal, metadata: Metadata, project: bool) -> tuple[np.ndarray, bool]:
    """Check a goal.

    Args:
        goal: From outside.
        metadata: Of the policy.
        project: Whether one out of reach is moved to the nearest in reach.

    Returns:
        The goal's numbers [g] in the policy's order, and whether they were moved.

    Raises:
        GoalError: If it has not as many finite numbers as the policy's goals, in their frame, or is out of reach.
    """
    signal = metadata.goal
    value = to_floats(goal.value) if isinstance(goal, Goal) else None
    if value is None:
        raise GoalError("malformed", f"it is not {signal.size} numbers")
    value = _ordered(value, goal.names, signal)
    if not np.isfinite(value).all():
        raise GoalError("not finite", "it is not finite")
    if not isinstance(goal.frame, str):
        raise GoalError("malformed", "its frame is no name")
    if signal.frame and goal.frame != signal.frame:
        raise GoalError("wrong frame", f"frame '{goal.frame}' is not '{signal.frame}'")
    if metadata.region.contains(value):
        return value, False
    nearest = metadata.region.project(value) if project else None
    if nearest is None or not metadata.region.contains(nearest):  # the nearest of one too far for floats is nowhere
        raise GoalError("unreachable", metadata.region.describe(value))
    return nearest, True


def _ordered(value: np.ndarray, names: Sequence[str], signal: Signal) -> np.ndarray:
    """Bring numbers that are named into the order of the signal."""
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise GoalError("malformed", "its names are no list of names")
    if not names:
        if value.shape != (signal.size,):
            raise GoalError("malformed", f"it has the shape {list(value.shape)}, not [{signal.size}]")
        return value
    if value.shape != (len(names),):
        raise GoalError("malformed", f"it has {len(names)} names for numbers of the shape {list(value.shape)}")
    if len(set(names)) < len(names):
        raise GoalError("malformed", "it names a number twice")
    for what, words in (
        ("does not name", [label for label in signal.labels if label not in names]),
        ("has no use for", [name for name in names if name not in signal.labels]),
    ):
        if words:
            labels = list(signal.labels)
            raise GoalError("malformed", f"it {what} {words[0][:80]!r}; the policy's goals are of {labels}")
    return value[[names.index(label) for label in signal.labels]]
