"""What the inference node tells about itself on /diagnostics (diagnostic_msgs, REP-107)."""

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from physai.deploy import Driver, State

_LEVELS = {
    State.WAITING.value: DiagnosticStatus.OK,
    State.ACTIVE.value: DiagnosticStatus.OK,
    State.REACHED.value: DiagnosticStatus.OK,
    State.HOLD.value: DiagnosticStatus.WARN,
    State.FAULT.value: DiagnosticStatus.ERROR,
    State.ESTOP.value: DiagnosticStatus.ERROR,
}


class Timing:
    """Rate and jitter of the last updates.

    Args:
        length: How many are looked at.
    """

    def __init__(self, length: int = 100) -> None:
        self._times: deque[float] = deque(maxlen=length + 1)

    def tick(self, now: float) -> None:
        """Count an update at a time, s."""
        self._times.append(now)

    def summary(self) -> dict[str, float | None]:
        """Mean rate, Hz, and the longest distance of a period from the mean, ms; None before the second update."""
        periods = np.diff(self._times)
        if not len(periods):
            return {"rate_hz": None, "jitter_ms": None}
        mean = periods.mean()
        return {"rate_hz": round(1.0 / mean, 2), "jitter_ms": round(1e3 * float(np.abs(periods - mean).max()), 3)}


def summary(state: str, reasons: Sequence[str]) -> str:
    """Say in one line what a controller does, and why."""
    return f"{state}: {'; '.join(reasons)}" if reasons else state


def diagnose(name: str, stamp: Time, policy: Driver, values: dict[str, Any]) -> DiagnosticArray:
    """Make the message from ``values``: a controller's snapshot, and whatever else is to be told."""
    flat = {**values, **{f"count: {key}": count for key, count in sorted(values["counters"].items())}}
    status = DiagnosticStatus(
        level=_LEVELS[values["state"]],
        name=f"{name}: arm",
        message=summary(values["state"], values["reasons"]),
        hardware_id=policy.metadata.robot,
        values=[
            KeyValue(key=key, value="" if value is None else str(value))
            for key, value in flat.items()
            if key not in ("state", "reasons", "counters")
        ],
    )
    message = DiagnosticArray(status=[status])
    message.header.stamp = stamp
    return message
