"""What a controller answers."""

import enum
from dataclasses import dataclass

import numpy as np


class State(enum.Enum):
    """What the controller does, and how it ends."""

    WAITING = "waiting"  # for a joint state, a goal, or permission to move
    ACTIVE = "active"  # the policy drives
    REACHED = "reached"  # stands at the goal, until it moves or the arm drifts
    HOLD = "hold"  # stands, until enough good joint states have come in a row, or a new goal
    FAULT = "fault"  # stands, until reset
    ESTOP = "estop"  # stands, until reset


@dataclass(frozen=True, eq=False)
class Command:
    """What to send to the arm.

    Attributes:
        value: [n] in the order of the policy's joints: rad/s, or rad where the policy commands positions. An arm that
            stands is sent zero velocities, or the positions where it stood still. None: send nothing, the arm has not
            been heard of yet.
        state: The controller's state.
        reasons: Why the arm stands or is held back, and what was refused; empty when the policy drives, within the
            limits of velocity and acceleration that always hold.
    """

    value: np.ndarray | None
    state: State
    reasons: tuple[str, ...]
