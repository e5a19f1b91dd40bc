"""What a search looks through: ranges in the grammar of Hydra's overrides, as Optuna's distributions."""

from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep, Transformer
from hydra.errors import HydraException
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from physai.compose import parse
from physai.errors import UserError

Space = dict[str, BaseDistribution]
"""A distribution for each key."""


def ranges(ready: Mapping[str, str], given: Sequence[str]) -> dict[str, str]:
    """What is searched: the ready ranges, and what the command line says in their place.

    Args:
        ready: Key and range, from ``conf/search/<algo>.yaml``.
        given: Overrides, with and without ranges.

    Returns:
        Key and range, such as ``interval(0.1, 0.4)``.
    """
    found = dict(ready)
    for override in parse(given):
        found.pop(override.get_key_element(), None)
        if override.is_sweep_override():
            found[override.get_key_element()] = override.get_value_string()
    return found


def make_space(ranges: Mapping[str, str]) -> Space:
    """Turn ranges into distributions.

    Raises:
        UserError: If one is no range, is empty, or is tagged with something else than ``log``.
    """
    space: Space = {}
    for key, text in ranges.items():
        (override,) = parse([f"{key}={text}"])
        try:
            space[key] = _distribution(override)
        except (ValueError, HydraException) as error:
            raise UserError(f"{key}={text}: {error}") from error
    return space


def _distribution(override: Override) -> BaseDistribution:
    if override.is_choice_sweep():
        choices: Any = list(override.sweep_iterator(_choice))
        return CategoricalDistribution(choices)
    sweep: Any = override.value()
    if not isinstance(sweep, RangeSweep | IntervalSweep):
        raise ValueError("a range is needed, such as interval(0.1,0.4) or choice(1,2,4)")
    if sweep.tags - {"log"}:
        raise ValueError("the only tag of a range is log")
    log, low, high, step = "log" in sweep.tags, *_bounds(sweep)
    if isinstance(low, int) and isinstance(high, int) and isinstance(step, int | None):
        return IntDistribution(low, high, log, step or 1)
    return FloatDistribution(low, high, log, step)


def _choice(value: Any) -> Any:
    """Numbers as they are, which have an order in pictures; anything else as on the command line."""
    return value if type(value) in (int, float) else Transformer.str(value)


def _bounds(sweep: Any) -> tuple[float, float, float | None]:
    """The smallest and the largest value, and the step between values."""
    if isinstance(sweep, IntervalSweep):
        return sweep.start, sweep.end, None  # type: ignore[return-value]
    values = list(sweep.range())
    if not values:
        raise ValueError("the range is empty")
    return min(values), max(values), abs(sweep.step)


def samples(space: Space) -> list[dict[str, Any]]:
    """So many values that every choice is in one of them, and both ends of everything else."""
    choices = [getattr(one, "choices", None) or (one.low, one.high) for one in space.values()]  # type: ignore[attr-defined]
    most = max(map(len, choices))
    rows = ([values[min(row, len(values) - 1)] for values in choices] for row in range(most))
    return [dict(zip(space, row, strict=True)) for row in rows]


def overrides(values: Mapping[str, Any]) -> list[str]:
    """Overrides that give these values to their keys."""
    return [f"{key}={value}" for key, value in values.items()]
