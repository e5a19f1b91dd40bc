"""Goals from outside: which are taken, and which are not."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physai.deploy.joints import to_floats
from physai.deploy.metadata import Metadata


@dataclass(frozen=True)
class Goal:
    """Where the end effector shall go.

    Attributes:
        position: x and y in the frame, m.
        frame: Name of the frame.
    """

    position: Sequence[float]
    frame: str


class GoalError(Exception):
    """A goal that cannot be taken: ``kind`` for counting, and a line for people."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def accept(goal: Goal, metadata: Metadata, project: bool) -> np.ndarray:
    """Return the goal's position [2], m, moved onto the ring of reachable goals if that is allowed.

    Raises:
        GoalError: If it is not two finite numbers in the right frame, or out of reach.
    """
    position = to_floats(goal.position) if isinstance(goal, Goal) else None
    if position is None:
        raise GoalError("malformed", "goal rejected: it is not two numbers")
    if position.shape != (2,):
        raise GoalError("malformed", f"goal rejected: it has the shape {list(position.shape)}, not [2]")
    radius = math.hypot(*position)
    if not math.isfinite(radius):
        raise GoalError("not finite", "goal rejected: it is not finite")
    if not isinstance(goal.frame, str):
        raise GoalError("malformed", "goal rejected: its frame is no name")
    if goal.frame != metadata.goal_frame:
        raise GoalError("wrong frame", f"goal rejected: frame '{goal.frame}' is not '{metadata.goal_frame}'")
    inner, outer = metadata.goal_radius
    # A goal on the very edge, written with fewer digits, is meant to be in.
    if inner - 1e-6 <= radius <= outer + 1e-6:
        return position
    if project and radius > 1e-6:
        return position * (min(max(radius, inner), outer) / radius)
    raise GoalError("unreachable", f"goal rejected: {radius:.3f} m from the base, not {inner:g} to {outer:g} m")
