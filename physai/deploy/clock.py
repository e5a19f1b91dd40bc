"""What a controller makes of the times at which it is asked."""

import math

LATE = 3.0  # control periods; an update that comes later stands still
_STILL = 3  # updates in a row at the same time


class Clock:
    """Says how much time has passed, and what is wrong with it.

    Args:
        period: Between two updates, s.

    Attributes:
        now: The last time that was one, s; None before the first.
        jump: What is no late update any more, s.
    """

    def __init__(self, period: float) -> None:
        self._period, self.jump = period, math.inf
        self.now: float | None = None
        self._still = 0  # updates in a row at that time

    def take(self, now: float) -> tuple[float, str, str]:
        """Take the time of an update; return how much has passed, s, why it cannot be true, and why it is late."""
        if not math.isfinite(now):
            return 0.0, "the time is not finite", ""
        before, self.now = self.now, now
        elapsed = self._period if before is None else now - before
        self._still = 0 if elapsed else self._still + 1
        if self._still >= _STILL:
            return 0.0, "the clock stands still", ""
        if elapsed < 0 or elapsed > self.jump:
            return 0.0, f"the clock jumped by {elapsed:.3f} s", ""
        periods = elapsed / self._period
        return elapsed, "", f"update came after {elapsed:.3f} s, {periods:.1f} periods" if periods > LATE else ""
