"""The controller's parameters, each declared once with unit, range and meaning."""

import contextlib
import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal

from physai.errors import UserError


def _parameter(default: Any, description: str, unit: str = "", low: float = 0.0, high: float = math.inf) -> Any:
    metadata = {"description": description, "unit": unit, "low": low, "high": high}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class ControllerConfig:
    """How carefully a policy is allowed to drive; every field has ``unit``, ``low``, ``high`` and ``description``.

    Raises:
        UserError: If a value is out of its range; the line names it.
    """

    max_velocity: float = _parameter(0.3, "fastest joint; slower ones keep the direction", "rad/s", 1e-3, 100.0)
    max_acceleration: float = _parameter(2.0, "largest change of a joint's velocity", "rad/s²", 1e-2, 1e4)
    limit_margin: float = _parameter(0.1, "no motion further into a position limit within this", "rad", 1e-3, 1.0)
    limit_velocity: float = _parameter(0.05, "fastest joint while one is beyond its limit", "rad/s", 1e-3, 100.0)
    limit_fault: float = _parameter(0.2, "farther than this beyond a position limit is a fault", "rad", 0.0, 10.0)
    state_timeout: float = _parameter(0.1, "a joint state older than this stops the arm", "s", 1e-3, 10.0)
    recovery_states: int = _parameter(5, "good joint states in a row that end a hold", "", 1, 1000)
    jump_factor: float = _parameter(
        3.0, "a joint this many times faster than its limit is a sensor error", "", 1.0, 1e3
    )
    allow_velocity_estimate: bool = _parameter(False, "estimate missing velocities from positions")
    unreachable_goal: Literal["reject", "project"] = _parameter("reject", "what to do with a goal out of reach")
    reached_hysteresis: float = _parameter(1.5, "a reached goal is left at this many tolerances", "", 1.0, 100.0)
    policy_timeout: float = _parameter(0.01, "a policy slower than this has failed", "s", 1e-5, 1.0)
    policy_failures: int = _parameter(3, "failures of the policy in a row that are a fault", "", 1, 1000)
    clock_jump: float = _parameter(1.0, "an update later than this is a jump of the clock", "s", 0.01, 3600.0)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value, kind = getattr(self, field.name), type(field.default)
            if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
                with contextlib.suppress(OverflowError):
                    object.__setattr__(self, field.name, value := float(value))  # people write 1 for 1.0
            if type(value) is not kind:
                raise UserError(f"{field.name}: a {kind.__name__} is needed, got {value!r}")
            low, high, unit = (field.metadata[key] for key in ("low", "high", "unit"))
            if kind in (int, float) and not low <= value <= high:
                raise UserError(
                    f"{field.name}: must lie between {low:g} and {high:g} {unit}".rstrip() + f", got {value}"
                )
        if self.unreachable_goal not in ("reject", "project"):
            raise UserError(f"unreachable_goal: must be 'reject' or 'project', got {self.unreachable_goal!r}")
