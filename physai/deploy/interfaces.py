"""What a robot is told: velocities as they are, or positions that move at these velocities."""

from typing import Protocol

import numpy as np

from physai.deploy.metadata import LAST_COMMAND, Metadata
from physai.deploy.parameters import ControllerConfig
from physai.signals import Quantity


class CommandInterface(Protocol):
    """Between the velocities that a controller decides on, whose limits hold for each robot, and what a robot takes."""

    def configure(self, config: ControllerConfig) -> None:
        """Take other limits."""

    def inputs(self, position: np.ndarray, turned: np.ndarray) -> dict[str, np.ndarray]:
        """Return what a policy of this interface also takes.

        Args:
            position: Where joints are, rad, [n].
            turned: The same, as the policy sees it: continuous joints between -π and π.
        """

    def velocity(self, answer: np.ndarray, position: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """Return the velocity [n], rad/s, that a policy's answer [n] asks for."""

    def drive(self, velocity: np.ndarray, position: np.ndarray, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the command [n] for a velocity [n], rad/s, and the velocity that it stands for, [n]."""

    def stand(self, position: np.ndarray) -> np.ndarray | None:
        """Return the command [n] that stands still, where the joints were as this began; None if that is not known."""

    def standstill(self, position: np.ndarray) -> np.ndarray:
        """Return the command [n] that would stand still where the joints are now."""


class VelocityInterface:
    """Commands are velocities; zero stands still."""

    def __init__(self, metadata: Metadata) -> None:
        self._zeros = np.zeros(len(metadata.joints))

    def configure(self, config: ControllerConfig) -> None:
        """See :class:`CommandInterface`."""

    def inputs(self, position: np.ndarray, turned: np.ndarray) -> dict[str, np.ndarray]:
        """See :class:`CommandInterface`."""
        return {}

    def velocity(self, answer: np.ndarray, position: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """See :class:`CommandInterface`."""
        return answer

    def drive(self, velocity: np.ndarray, position: np.ndarray, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`CommandInterface`."""
        return velocity, velocity

    def stand(self, position: np.ndarray) -> np.ndarray | None:
        """See :class:`CommandInterface`."""
        return self._zeros

    def standstill(self, position: np.ndarray) -> np.ndarray:
        """See :class:`CommandInterface`."""
        return self._zeros


class PositionInterface:
    """Commands are positions: the last one moves on; a robot that stands is told where it was as it stopped.

    Args:
        metadata: Of the policy.
        config: ``max_lead`` is used.
    """

    def __init__(self, metadata: Metadata, config: ControllerConfig) -> None:
        self._period = 1.0 / metadata.control_rate
        self._lower, self._upper = metadata.position_limit.T
        self._continuous = np.isinf(metadata.position_limit).all(axis=1)
        self._target: np.ndarray | None = None
        self._driving = False
        self.configure(config)

    def configure(self, config: ControllerConfig) -> None:
        """See :class:`CommandInterface`."""
        self._max_lead = config.max_lead

    def inputs(self, position: np.ndarray, turned: np.ndarray) -> dict[str, np.ndarray]:
        """See :class:`CommandInterface`."""
        return {LAST_COMMAND: turned + self._lead(position)}

    def velocity(self, answer: np.ndarray, position: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """See :class:`CommandInterface`."""
        return (answer - (turned + self._lead(position))) / self._period

    def drive(self, velocity: np.ndarray, position: np.ndarray, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`CommandInterface`; a command is never far from where its joint is."""
        lead = self._lead(position)
        # A joint may be beyond a limit: the command must not be farther out than it is.
        lowest = np.maximum(-self._max_lead, np.minimum(self._lower - position, 0.0))
        highest = np.minimum(self._max_lead, np.maximum(self._upper - position, 0.0))
        ahead = np.minimum(np.maximum(lead + velocity * elapsed, lowest), highest)
        self._target, self._driving = position + ahead, True
        return self._target, (ahead - lead) / elapsed if elapsed > 0 else velocity

    def stand(self, position: np.ndarray) -> np.ndarray | None:
        """See :class:`CommandInterface`."""
        if self._driving or self._target is None:
            self._driving = False
            self._target = position.copy() if np.isfinite(position).all() else None
        return self._target

    def standstill(self, position: np.ndarray) -> np.ndarray:
        """See :class:`CommandInterface`."""
        return position

    def _lead(self, position: np.ndarray) -> np.ndarray:
        """How far the command is ahead of the joints, rad; none where they stood."""
        if not self._driving or self._target is None:
            return np.zeros_like(position)
        lead = self._target - position
        # A source may count a continuous joint from -π to π.
        return np.where(self._continuous, lead - 2 * np.pi * np.round(lead / (2 * np.pi)), lead)


def make_interface(metadata: Metadata, config: ControllerConfig) -> CommandInterface:
    """Return the interface of a policy's commands."""
    if metadata.command.quantity is Quantity.JOINT_POSITION:
        return PositionInterface(metadata, config)
    return VelocityInterface(metadata)
