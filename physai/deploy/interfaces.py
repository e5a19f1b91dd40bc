"""What drives a robot, joint velocities or positions, or legs: what is sent while it drives, and while it stands."""

import math

import numpy as np

from physai.deploy.limits import VelocityLimits
from physai.deploy.metadata import Metadata
from physai.deploy.parameters import ControllerConfig
from physai.signals import Quantity

_ROUNDING = 2e-6  # rad; of positions of single precision, within two turns


class VelocityInterface:
    """The robot is sent joint velocities; it stands at zero.

    Args:
        metadata: Of the policy.

    Attributes:
        velocity: What it was told last, rad/s, [n].
        last_command: An input of policies that command positions; None.
        rounding: How far single precision may put a wanted velocity beyond its range, rad/s.
    """

    rounding = 0.0
    last_command: np.ndarray | None = None

    def __init__(self, metadata: Metadata) -> None:
        self._zeros = self.velocity = np.zeros(len(metadata.joints))

    def configure(self, config: ControllerConfig, limits: VelocityLimits) -> None:
        """Take other limits. A lower velocity holds at once: the margin may be too narrow for another."""
        self.velocity = limits.scaled(self.velocity)

    def begin(self, position: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """Prepare to ask the policy; return where the joints are told to be, rad, [n]: here, where they are.

        Args:
            position: Where they are, rad, [n], as the robot counts.
            turned: The same, as the policy counts.
        """
        return position

    def wanted(self, answer: np.ndarray) -> np.ndarray:
        """Turn what the policy answers into velocities, rad/s, [n]."""
        return answer

    def drive(self, velocity: np.ndarray, elapsed: float) -> tuple[np.ndarray, str | None]:
        """Go on with velocities [n], rad/s, within the limits, ``elapsed`` s after the last update.

        Returns:
            What to send, [n]; and why a joint is not told to go as far as that, if one is not.
        """
        self.velocity = velocity
        return velocity, None

    def stand(self, position: np.ndarray) -> np.ndarray | None:
        """Stand still; return what to send, [n], or None if that is not known yet.

        Args:
            position: Where the joints are, rad, [n]; NaN where that is not known.
        """
        self.velocity = self._zeros
        return self.velocity

    def standstill(self, position: np.ndarray) -> np.ndarray:
        """Return what would make the robot stand where its joints are now, [n]."""
        return self._zeros

    def way(self, passed: float) -> np.ndarray:
        """How far the joints were told to go, rad, [n], from the last update until now, ``passed`` s later."""
        return self.velocity * passed


class PositionInterface(VelocityInterface):
    """The robot is sent joint positions, a target that moves with a limited velocity; it stands where it was found.

    The target stays within ``max_lead`` of where each joint is, so that an arm that was held up does not leap, and
    within the position limits. It is counted as the robot counts: where a continuous joint is counted from -π to π, the
    target goes around with it.

    Args:
        metadata: Of the policy.
    """

    def __init__(self, metadata: Metadata) -> None:
        super().__init__(metadata)
        self._period = 1.0 / metadata.control_rate
        self.rounding = _ROUNDING / self._period
        self._continuous = np.isinf(metadata.position_limit).all(axis=1)
        self._target: np.ndarray | None = None
        self._drives = False
        self._way = self._zeros

    def configure(self, config: ControllerConfig, limits: VelocityLimits) -> None:
        """See :class:`VelocityInterface`."""
        super().configure(config, limits)
        self._limits, self._lead = limits, config.max_lead

    def begin(self, position: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """See :class:`VelocityInterface`; an arm that stood begins where it is."""
        target = self._turned(position) if self._drives else None
        self._position, self._before = position, position.copy() if target is None else target
        # As the policy sees it: what it adds to the last command is then exactly what it wants.
        self.last_command = (self._before - (position - turned)).astype(np.float32)
        return self._before

    def wanted(self, answer: np.ndarray) -> np.ndarray:
        """See :class:`VelocityInterface`."""
        return (answer - self.last_command) / self._period

    def drive(self, velocity: np.ndarray, elapsed: float) -> tuple[np.ndarray, str | None]:
        """See :class:`VelocityInterface`."""
        position = self._position
        target = self._before + velocity * elapsed
        ahead = (np.abs(target - position) > self._lead).any()
        least, most = self._limits.room(position)
        least, most = np.maximum(least, position - self._lead), np.minimum(most, position + self._lead)
        self._target = np.minimum(np.maximum(target, least), most)
        self._way = self._target - self._before
        # What was held back goes on from the velocity that it had; not from one to which it was pulled back.
        went = self._way / elapsed if elapsed > 0 else self._way
        went = np.minimum(np.maximum(went, np.minimum(velocity, 0.0)), np.maximum(velocity, 0.0))
        self.velocity = np.where(self._target == target, velocity, went)
        self._drives = True
        return self._target, f"a command waits {self._lead:g} rad ahead of its joint" if ahead else None

    def stand(self, position: np.ndarray) -> np.ndarray | None:
        """See :class:`VelocityInterface`; what is far from where it stood, or another robot, stands where it is now."""
        super().stand(position)
        self._way = self._zeros
        target = None if self._drives else self._turned(position)
        self._drives = False
        if not np.isfinite(position).all():
            self._target = None
        elif target is None or np.abs(target - position).max() > self._lead:
            self._target = position.copy()
        else:
            self._target = target
        return self._target

    def standstill(self, position: np.ndarray) -> np.ndarray:
        """See :class:`VelocityInterface`."""
        return position

    def way(self, passed: float) -> np.ndarray:
        """See :class:`VelocityInterface`."""
        return self._way

    def _turned(self, position: np.ndarray) -> np.ndarray | None:
        """The target, counted in the same turn as the position."""
        if self._target is None or not self._continuous.any():
            return self._target
        turns = np.where(self._continuous, np.round((position - self._target) / (2 * math.pi)), 0.0)
        return self._target + 2 * math.pi * turns


class StanceInterface(VelocityInterface):
    """Legs are sent joint positions, which their springs close in on; they stand where they were told to be last.

    Attributes:
        target: What was sent last, rad, [n]; None where that does not hold any more.
        drives: Whether the policy wanted that.
    """

    target: np.ndarray | None = None
    drives = False

    def configure(self, config: ControllerConfig, limits: VelocityLimits) -> None:
        """See :class:`VelocityInterface`; none of these matter to legs."""

    def drive(self, velocity: np.ndarray, elapsed: float) -> tuple[np.ndarray, str | None]:
        """See :class:`VelocityInterface`; go on with positions [n], rad, in the place of velocities."""
        self.target, self.drives = velocity, True
        return velocity, None

    def stand(self, position: np.ndarray) -> np.ndarray | None:
        """See :class:`VelocityInterface`; it keeps what the policy wanted."""
        if self.target is None and np.isfinite(position).all():
            self.target, self.drives = position.copy(), False
        return self.target

    def release(self) -> None:
        """Forget what was sent: others may have moved the robot since."""
        self.target, self.drives = None, False

    def give_way(self, position: np.ndarray) -> np.ndarray | None:
        """Leave springs without force, so that damping is all that is left; return what to send, [n].

        Args:
            position: Where the joints are, rad, [n]; NaN where that is not known.
        """
        self.release()
        return position.copy() if np.isfinite(position).all() else None

    def standstill(self, position: np.ndarray) -> np.ndarray:
        """See :class:`VelocityInterface`; what carries a robot must not let go."""
        return position if self.target is None else self.target


def interface_of(metadata: Metadata) -> VelocityInterface:
    """Return how the robot of a policy is driven."""
    if metadata.floats:
        return StanceInterface(metadata)
    takes_positions = metadata.command.quantity is Quantity.JOINT_POSITION
    return PositionInterface(metadata) if takes_positions else VelocityInterface(metadata)
