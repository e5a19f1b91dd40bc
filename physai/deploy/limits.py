"""From what a policy wants to what an arm may do: the limits, in the order in which they hold."""

import math

import numpy as np

from physai.deploy.clock import LATE
from physai.deploy.metadata import Metadata
from physai.deploy.parameters import ControllerConfig
from physai.errors import UserError

_ROOM = 1 + 1e-6  # of single precision


class VelocityLimits:
    """Limits on a vector of joint velocities.

    Args:
        metadata: Position limits of the joints and the range of the policy's commands.
        config: ``max_velocity``, ``max_acceleration`` and the ``limit_`` values are used.
    """

    def __init__(self, metadata: Metadata, config: ControllerConfig) -> None:
        lower, upper = metadata.position_limit.T
        self._command, self._range = metadata.command_limit, metadata.command_limit * _ROOM
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

    def out_of_range(self, wanted: np.ndarray, rounding: float = 0.0) -> bool:
        """Whether this is more than the policy was trained to ask for, with room for ``rounding``, rad/s."""
        allowed = self._range + rounding if rounding else self._range
        return bool((np.abs(wanted) > allowed).any())

    def scaled(self, velocity: np.ndarray) -> np.ndarray:
        """Return velocities [n], rad/s, slowed down to the largest that is allowed, in their direction."""
        largest = np.abs(velocity).max()
        return velocity * (self._max_velocity / largest) if largest > self._max_velocity else velocity

    def apply(
        self, wanted: np.ndarray, position: np.ndarray, target: np.ndarray, last: np.ndarray, elapsed: float
    ) -> tuple[np.ndarray, str | None]:
        """Return the velocities [n], rad/s, that may be commanded now; and what a position limit had to do with it.

        Args:
            wanted: What the policy wants, finite, rad/s.
            position: Where the joints are, rad.
            target: Where they are told to be; the same where they are not told.
            last: What was commanded last, rad/s.
            elapsed: Time since then, s.
        """
        velocity = np.minimum(np.maximum(wanted, -self._command), self._command)  # twice as fast as np.clip
        beyond = ((position < self._lower) | (position > self._upper)).any()
        reason = "a joint is beyond its position limit: slow" if beyond else None
        fastest, largest = (self._limit_velocity if beyond else self._max_velocity), np.abs(velocity).max()
        if largest > fastest:
            velocity = velocity * (fastest / largest)
        # Outward motion at a limit stops at once, what is wanted as what still goes on.
        told = target is not position
        most, least = (np.maximum(position, target), np.minimum(position, target)) if told else (position, position)
        highest = np.where(most >= self._inner_upper, 0.0, np.inf)
        lowest = np.where(least <= self._inner_lower, 0.0, -np.inf)
        inward = np.minimum(np.maximum(velocity, lowest), highest)
        going, last = last, np.minimum(np.maximum(last, lowest), highest)
        if reason is None and ((inward != velocity) | (going != last)).any():
            reason = "a joint is at its position limit: no motion outward"
        change = inward - last
        allowed, largest = self._max_acceleration * elapsed, np.abs(change).max()
        velocity = inward if largest <= allowed else last + change * (allowed / largest)
        velocity = np.where(going == last, velocity, 0.0)
        if beyond and (largest := np.abs(velocity).max()) > fastest:  # slow at once, however fast it was
            velocity = velocity * (fastest / largest)
        return velocity, reason

    def room(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest positions [n], rad, that may be commanded: the limits, or where a joint is beyond."""
        return np.minimum(self._lower, position), np.maximum(self._upper, position)


def smallest_margin(max_velocity: float, state_timeout: float, period: float) -> float:
    """What the arm may travel until an old joint state stops it, and an update that is just not late sees that.

    Args:
        max_velocity: rad/s.
        state_timeout: s.
        period: Between updates, s.

    Returns:
        rad, rounded up to a thousandth.
    """
    return math.ceil(max_velocity * (state_timeout + LATE * period) * 1e3 - 1e-6) / 1e3


def check(config: ControllerConfig, metadata: Metadata) -> None:
    """See that limits and timeouts fit a robot.

    Raises:
        UserError: If they do not, and which.
    """
    period = 1.0 / metadata.control_rate
    slowest = metadata.velocity_limit.min()
    if config.max_velocity > slowest:
        raise UserError(f"max_velocity: {config.max_velocity} rad/s is beyond the robot's limit, {slowest:g} rad/s")
    if config.clock_jump <= LATE * period:
        raise UserError(f"clock_jump: must be longer than {LATE:g} control periods, got {config.clock_jump}")
    if config.resume_timeout < config.state_timeout:  # a goal would be forgotten before anything holds
        raise UserError(
            f"resume_timeout: must be as long as state_timeout, {config.state_timeout} s, at least, "
            f"got {config.resume_timeout}"
        )
    span = (metadata.position_limit[:, 1] - metadata.position_limit[:, 0]).min()
    if 2 * config.limit_margin >= span:
        raise UserError(f"limit_margin: {config.limit_margin} rad leaves no room between the position limits")
    blind = smallest_margin(config.max_velocity, config.state_timeout, period)
    if np.isfinite(metadata.position_limit).any() and blind > config.limit_margin + 1e-9:
        raise UserError(
            f"limit_margin: at {config.max_velocity} rad/s and a state_timeout of {config.state_timeout} s it must be "
            f"{blind:.3f} rad at least, got {config.limit_margin}"
        )
