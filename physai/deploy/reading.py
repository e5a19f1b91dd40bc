"""Reading JSON that nobody has vouched for: each part is there, of its type and shape, or named in one line."""

import math
from typing import Any

import numpy as np

from physai.errors import UserError


class PolicyError(UserError):
    """A policy file that cannot be trusted or does not fit: one line that says why."""

    def __init__(self, message: str) -> None:
        # It may quote the file: no line breaks, no control characters for the terminal that shows it.
        super().__init__("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in message))


def get(raw: dict[str, Any], key: str, kind: type) -> Any:
    """Return what lies under a dotted key; raises a PolicyError if it is not there, or of another type."""
    value: Any = raw
    for part in key.split("."):
        if isinstance(value, list) and part.isdigit():
            value = value[int(part)]
        elif isinstance(value, dict) and part in value:
            value = value[part]
        else:
            raise PolicyError(f"metadata: {key} is missing")
    if not isinstance(value, kind):
        raise PolicyError(f"metadata: {key} must be a {kind.__name__}")
    return value


def items(raw: dict[str, Any], key: str, most: int, what: str) -> list[str]:
    """Return the dotted keys of the items of a list of 1 to ``most``; ``what`` they are, for errors."""
    count = len(get(raw, key, list))
    if not 0 < count <= most:
        raise PolicyError(f"metadata: {key} must be a list of {what}")
    return [f"{key}.{number}" for number in range(count)]


def array(
    raw: dict[str, Any],
    key: str,
    shape: tuple[int, ...],
    kind: type = np.float64,
    null: float | list[float] | None = None,  # what null stands for: JSON has no infinity
) -> np.ndarray:
    """Return numbers of a shape; raises a PolicyError if they are not, or not finite."""
    value = get(raw, key, object)
    try:
        if not all_numbers(value):
            raise TypeError
        with np.errstate(over="ignore"):
            numbers: np.ndarray = np.array(value, dtype=np.float64).astype(kind)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise PolicyError(f"metadata: {key} must hold numbers") from error
    if numbers.shape != shape:
        raise PolicyError(f"metadata: {key} must have the shape {list(shape)}, not {list(numbers.shape)}")
    if null is not None:
        return np.where(np.isnan(numbers), null, numbers)
    if not np.isfinite(numbers).all():
        raise PolicyError(f"metadata: {key} must be finite")
    return numbers


def all_numbers(value: Any) -> bool:
    """Whether something is a number, None, or lists of them."""
    if isinstance(value, list):
        return all(map(all_numbers, value))
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def positive(raw: dict[str, Any], key: str, shape: tuple[int, ...], most: float = math.inf) -> np.ndarray:
    """Return numbers of a shape; raises a PolicyError if they are not positive, or above ``most``."""
    numbers = array(raw, key, shape)
    if not ((numbers > 0) & (numbers <= most)).all():
        raise PolicyError(f"metadata: {key} must be positive" + (f", and at most {most:g}" if most < math.inf else ""))
    return numbers
