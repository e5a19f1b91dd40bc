"""Parameters of a controller or a node, each declared once with unit, range and meaning."""

import contextlib
import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from physai.errors import UserError


def parameter(
    default: Any,
    description: str,
    unit: str = "",
    low: float = 0.0,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    fixed: bool = False,
) -> Any:
    """Declare a field of :class:`Parameters`; its type is that of the default.

    Args:
        default: float, int, bool, str, or a tuple of str or float.
        description: What it does, in a few words.
        unit: Such as ``rad/s``.
        low: Smallest value of a number, or of each in a tuple.
        high: Largest value.
        choices: What a string may be; empty for any.
        fixed: Whether it keeps its value while the program runs.
    """
    metadata = {"description": description, "unit": unit, "low": low, "high": high, "choices": choices, "fixed": fixed}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Parameters:
    """A frozen dataclass whose fields are checked; each has ``description``, ``unit``, ``low``, ``high`` and more.

    Raises:
        UserError: If values are of a wrong type or out of range; the line names all of them.
    """

    def __post_init__(self) -> None:
        problems = [problem for field in dataclasses.fields(self) if (problem := self._problem(field))]
        if problems:
            raise UserError("; ".join(problems))

    def _problem(self, field: "dataclasses.Field[Any]") -> str | None:
        value: Any = getattr(self, field.name)
        kind = type(field.default)
        if kind is tuple and isinstance(value, list | tuple):
            wanted = float if "float" in str(field.type) else str
            value = tuple(map(_to_float, value) if wanted is float else value)
            object.__setattr__(self, field.name, value)
            if not all(type(item) is wanted for item in value):
                return f"{field.name}: a list of {wanted.__name__} is needed, got {list(value)!r}"
            if wanted is str:
                return None
        elif kind is float:
            object.__setattr__(self, field.name, value := _to_float(value))  # people write 1 for 1.0
        if type(value) is not kind:
            return f"{field.name}: a {kind.__name__} is needed, got {value!r}"
        low, high, unit, choices = (field.metadata[key] for key in ("low", "high", "unit", "choices"))
        if kind in (int, float, tuple) and not all(low <= number <= high for number in np.atleast_1d(value)):  # type: ignore[arg-type]
            return f"{field.name}: must lie between {low:g} and {high:g} {unit}".rstrip() + f", got {value}"
        if choices and value not in choices:
            return f"{field.name}: must be {' or '.join(map(repr, choices))}, got {value!r}"
        return None


def _to_float(value: Any) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):
            return float(value)
    return value


@dataclass(frozen=True)
class ControllerConfig(Parameters):
    """How carefully a policy is allowed to drive."""

    max_velocity: float = parameter(0.3, "fastest joint; slower ones keep the direction", "rad/s", 1e-3, 100.0)
    max_acceleration: float = parameter(2.0, "largest change of a joint's velocity", "rad/s²", 1e-2, 1e4)
    limit_margin: float = parameter(0.1, "no motion further into a position limit within this", "rad", 1e-3, 1.0)
    limit_velocity: float = parameter(0.05, "fastest joint while one is beyond its limit", "rad/s", 1e-3, 100.0)
    limit_fault: float = parameter(0.2, "farther than this beyond a position limit is a fault", "rad", 0.0, 10.0)
    max_lead: float = parameter(
        0.25, "a position command is at most this far from where its joint is", "rad", 1e-3, 3.0
    )
    state_timeout: float = parameter(0.1, "a joint state older than this stops the arm", "s", 1e-3, 10.0)
    resume_timeout: float = parameter(
        1.0, "a robot silent for longer is not driven on to its old goal", "s", 1e-3, 3600.0
    )
    recovery_states: int = parameter(5, "good joint states in a row that end a hold", "", 1, 1000)
    jump_factor: float = parameter(3.0, "a joint this many times faster than its limit is a sensor error", "", 1.0, 1e3)
    allow_velocity_estimate: bool = parameter(False, "estimate missing velocities from positions")
    unreachable_goal: Literal["reject", "project"] = parameter(
        "reject", "what to do with a goal out of reach", choices=("reject", "project")
    )
    reached_hysteresis: float = parameter(1.5, "a reached goal is left at this many tolerances", "", 1.0, 100.0)
    policy_timeout: float = parameter(0.01, "a policy slower than this has failed", "s", 1e-5, 1.0)
    policy_failures: int = parameter(3, "failures of the policy in a row that are a fault", "", 1, 1000)
    following_error: float = parameter(
        0.3, "share of the commanded motion that may be missing, or too much, before it is a fault", "", 0.05, 100.0
    )
    following_window: float = parameter(
        0.3, "time over which commanded and measured motion are compared", "s", 0.1, 10.0
    )
    velocity_error: float = parameter(
        0.25, "reported velocities that differ by more from the moved positions are sensor errors", "rad/s", 0.01, 100.0
    )
    progress_timeout: float = parameter(
        10.0, "a distance that has not fallen for this long ends the motion", "s", 0.1, 3600.0
    )
    collision_margin: float = parameter(
        0.01, "no motion that brings links closer than this to each other, to the floor or to a box", "m", 0.0, 1.0
    )
    stopping_time: float = parameter(
        0.12, "what the arm needs to stop; so far ahead collisions are seen", "s", 0.0, 2.0
    )
    floor: tuple[float, ...] = parameter(
        (), "its height in the base frame; empty: as in the policy file", "m", -100.0, 100.0
    )
    boxes: tuple[float, ...] = parameter(
        (), "what stands around: x, y, z of a centre and of half the edges, box by box", "m", -100.0, 100.0
    )
    effort_time: float = parameter(0.5, "an effort beyond its limit for this long is a fault", "s", 0.0, 60.0)
    command_timeout: float = parameter(0.5, "legs: without a newer velocity command it stands", "s", 0.05, 60.0)
    rise_time: float = parameter(1.0, "legs: it stands up in this time, then it walks", "s", 0.0, 60.0)
    max_tilt: float = parameter(0.8, "legs: to lean by more is a fault", "rad", 0.1, 3.1)
    clock_jump: float = parameter(1.0, "an update later than this is a jump of the clock", "s", 0.01, 3600.0)
