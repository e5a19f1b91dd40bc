"""What a controller answers."""

import enum
from dataclasses import dataclass

import numpy as np


class State(enum.Enum):
    """What the controller does, and how it ends."""

    WAITING = "waiting"  # for a joint state, a goal, or permission to move
    ACTIVE = "active"  # the policy drives
    REACHED = "reached"  # stands at the goal, until it moves or the arm drifts
    HOLD = "hold"  # stands still, until enough good joint states have come in a row, or a new goal
    FAULT = "fault"  # stands still, until reset
    ESTOP = "estop"  # stands still, until reset


@dataclass(frozen=True, eq=False)
class Command:
    """What to send to the arm.

    Attributes:
        value: rad/s or rad, as the policy's command signal says, in the order of its joints; None: send nothing, the
            arm has not been heard of yet.
        state: The controller's state.
        reasons: Why the arm stands or is held back, and what was refused; empty when the policy drives, within the
            limits of velocity and acceleration that always hold.
    """

    value: np.ndarray | None
    state: State
    reasons: tuple[str, ...]
