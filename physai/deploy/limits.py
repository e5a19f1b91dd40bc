"""From what a policy wants to what an arm may do: the limits, in the order in which they hold."""

import numpy as np

from physai.deploy.metadata import Metadata
from physai.deploy.parameters import ControllerConfig


class VelocityLimits:
    """Limits on a vector of joint velocities.

    Args:
        metadata: Position limits of the joints and the range of the policy's commands.
        config: ``max_velocity``, ``max_acceleration`` and the ``limit_`` values are used.
    """

    def __init__(self, metadata: Metadata, config: ControllerConfig) -> None:
        lower, upper = metadata.position_limit.T
        self._command = metadata.command_limit
        self._lower, self._upper = lower, upper
        self._inner_lower, self._inner_upper = lower + config.limit_margin, upper - config.limit_margin
        self._fault_lower, self._fault_upper = lower - config.limit_fault, upper + config.limit_fault
        self._max_velocity = config.max_velocity
        self._limit_velocity = min(config.limit_velocity, config.max_velocity)
        self._max_acceleration = config.max_acceleration

    def far_beyond(self, position: np.ndarray) -> int | None:
        """Index of a joint that is farther beyond its position limit than any arm should come."""
        far = (position < self._fault_lower) | (position > self._fault_upper)
        return int(far.argmax()) if far.any() else None

    def out_of_range(self, wanted: np.ndarray) -> bool:
        """Whether this is more than the policy was trained to command (with room for rounding)."""
        return bool((np.abs(wanted) > self._command * (1 + 1e-6)).any())

    def apply(
        self, wanted: np.ndarray, position: np.ndarray, last: np.ndarray, elapsed: float
    ) -> tuple[np.ndarray, str | None]:
        """Return the velocities [n], rad/s, that may be commanded now; and what a position limit had to do with it.

        Args:
            wanted: What the policy wants, finite, rad/s.
            position: Where the joints are, rad.
            last: What was commanded last, rad/s.
            elapsed: Time since then, s.
        """
        velocity = np.clip(wanted, -self._command, self._command)
        beyond = ((position < self._lower) | (position > self._upper)).any()
        reason = "a joint is beyond its position limit: slow" if beyond else None
        fastest, largest = (self._limit_velocity if beyond else self._max_velocity), np.abs(velocity).max()
        if largest > fastest:
            velocity = velocity * (fastest / largest)
        # Outward motion at a limit stops at once, what is wanted as what still goes on.
        highest = np.where(position >= self._inner_upper, 0.0, np.inf)
        lowest = np.where(position <= self._inner_lower, 0.0, -np.inf)
        inward = np.clip(velocity, lowest, highest)
        going, last = last, np.clip(last, lowest, highest)
        if reason is None and ((inward != velocity) | (going != last)).any():
            reason = "a joint is at its position limit: no motion outward"
        change = inward - last
        allowed, largest = self._max_acceleration * elapsed, np.abs(change).max()
        velocity = inward if largest <= allowed else last + change * (allowed / largest)
        return np.where(going == last, velocity, 0.0), reason
