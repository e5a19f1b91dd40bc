"""Signals, regions and tolerances in a policy file: written as JSON, and read back with every part checked."""

import dataclasses
import math
from typing import Any

import numpy as np

from physai.deploy import fields
from physai.deploy.fields import PolicyError
from physai.signals import Quantity, Region, Signal, Tolerance
from physai.signals.region import REGIONS

MAX_NUMBERS = 65536  # of a signal


def describe_signal(signal: Signal) -> dict[str, Any]:
    """A signal as JSON: null stands for an infinite bound, and the unit is there for people."""
    return {
        "name": signal.name,
        "quantity": signal.quantity.value,
        "unit": signal.unit,
        "shape": list(signal.shape),
        "low": [number if math.isfinite(number) else None for number in signal.low],
        "high": [number if math.isfinite(number) else None for number in signal.high],
        "labels": list(signal.labels),
        "frame": signal.frame,
    }


def describe_region(region: Region) -> dict[str, Any]:
    """A region as JSON: its kind and its fields."""
    values = {field.name: getattr(region, field.name) for field in dataclasses.fields(REGIONS[region.kind])}
    return {"kind": region.kind} | {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}


def parse_signals(raw: dict[str, Any], side: str) -> tuple[Signal, ...]:
    """Read the list of signals at a key.

    Raises:
        PolicyError: If one of them is not what a signal is; it says which.
    """
    declared = fields.get(raw, side, list)
    if not declared:
        raise PolicyError(f"metadata: {side} must not be empty")
    return tuple(_parse_signal(one, f"{side}.{number}") for number, one in enumerate(declared))


def _parse_signal(raw: Any, what: str) -> Signal:
    if not isinstance(raw, dict):
        raise PolicyError(f"metadata: {what} must be a signal")
    name, quantity, frame, unit = (_text(raw, what, key) for key in ("name", "quantity", "frame", "unit"))
    if quantity not in list(Quantity):
        raise PolicyError(f"metadata: {what}.quantity is unknown: {quantity[:80]!r}")
    shape = _value(raw, what, "shape")
    if not isinstance(shape, list) or not all(type(axis) is int and axis > 0 for axis in shape):
        raise PolicyError(f"metadata: {what}.shape must be a list of positive whole numbers")
    size = math.prod(shape)
    if not shape or size > MAX_NUMBERS:
        raise PolicyError(f"metadata: {what}.shape must be of 1 to {MAX_NUMBERS:,} numbers")
    labels = fields.texts(_value(raw, what, "labels"), f"{what}.labels")
    if len(labels) not in (0, size) or len(set(labels)) != len(labels):
        raise PolicyError(f"metadata: {what}.labels must be {size} distinct names, or none")
    low = fields.bounds(_value(raw, what, "low"), f"{what}.low", size, -math.inf)
    high = fields.bounds(_value(raw, what, "high"), f"{what}.high", size, math.inf)
    signal = Signal(name, Quantity(quantity), tuple(shape), low, high, labels, frame)
    if not np.less_equal(*signal.bounds).all():
        raise PolicyError(f"metadata: {what}.low must not be above {what}.high")
    if unit != signal.unit:
        raise PolicyError(f"metadata: {what}.unit must be '{signal.unit}'")
    return signal


def parse_region(raw: dict[str, Any], key: str, size: int) -> Region:
    """Read the region at a key, of goals of ``size`` numbers.

    Raises:
        PolicyError: If it is none, or for goals of another size.
    """
    kind = REGIONS.get(fields.get(raw, f"{key}.kind", str))
    if kind is None:
        raise PolicyError(f"metadata: {key}.kind must be one of {', '.join(REGIONS)}")
    values: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        what, shape = f"{key}.{field.name}", () if field.type is float else (size,)
        number = fields.array(fields.get(raw, what, object), what, shape).tolist()
        values[field.name] = tuple(number) if shape else number
    try:
        region = kind(**values)
    except ValueError as error:
        raise PolicyError(f"metadata: {key}: {error}") from None
    if len(region.bounds[0]) != size:
        raise PolicyError(f"metadata: {key} must be of goals of {size} numbers")
    return region


def parse_tolerances(raw: dict[str, Any], key: str, unit: str, region: Region) -> tuple[Tolerance, ...]:
    """Read how near is near enough: one for each unit.

    Raises:
        PolicyError: If there is none, or one is not positive, or, in the ``unit`` of the goals, larger than their
            ``region``.
    """
    largest = float(np.abs(region.bounds).max())
    declared = fields.get(raw, key, list)
    if not declared:
        raise PolicyError(f"metadata: {key} must not be empty")
    found = []
    for number, one in enumerate(declared):
        what = f"{key}.{number}"
        if not isinstance(one, dict):
            raise PolicyError(f"metadata: {what} must be a tolerance")
        name, its_unit = _text(one, what, "name"), _text(one, what, "unit")
        most = largest if its_unit == unit else math.inf
        value = fields.positive(_value(one, what, "value"), f"{what}.value", (), most)
        found.append(Tolerance(name, its_unit, float(value)))
    return tuple(found)


def _value(raw: dict[str, Any], what: str, key: str) -> Any:
    if key not in raw:
        raise PolicyError(f"metadata: {what}.{key} is missing")
    return raw[key]


def _text(raw: dict[str, Any], what: str, key: str) -> str:
    value = _value(raw, what, key)
    if not isinstance(value, str):
        raise PolicyError(f"metadata: {what}.{key} must be a str")
    return value
