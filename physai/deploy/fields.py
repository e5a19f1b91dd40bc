"""Reading fields of untrusted JSON: each is there, of its type, of its shape and finite, or refused by name."""

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
    """Return the value at a dotted key.

    Raises:
        PolicyError: If it is missing, or of another type.
    """
    value: Any = raw
    for part in key.split("."):
        if not isinstance(value, dict) or part not in value:
            raise PolicyError(f"metadata: {key} is missing")
        value = value[part]
    if not isinstance(value, kind):
        raise PolicyError(f"metadata: {key} must be a {kind.__name__}")
    return value


def texts(value: Any, what: str) -> tuple[str, ...]:
    """Return a list of texts.

    Raises:
        PolicyError: If it is none.
    """
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise PolicyError(f"metadata: {what} must be a list of texts")
    return tuple(value)


def array(value: Any, what: str, shape: tuple[int, ...], dtype: type = np.float64, null: bool = False) -> np.ndarray:
    """Return finite numbers of a shape; with ``null``, a missing one is NaN.

    Raises:
        PolicyError: If they are no numbers, of another shape, or not finite.
    """
    try:
        if not _all_numbers(value, null):
            raise TypeError
        with np.errstate(over="ignore"):
            found: np.ndarray = np.array(value, dtype=np.float64).astype(dtype)
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise PolicyError(f"metadata: {what} must hold numbers") from None
    if found.shape != shape:
        raise PolicyError(f"metadata: {what} must have the shape {list(shape)}, not {list(found.shape)}")
    if not null and not np.isfinite(found).all():
        raise PolicyError(f"metadata: {what} must be finite")
    return found


def positive(value: Any, what: str, shape: tuple[int, ...], most: float = math.inf) -> np.ndarray:
    """Return numbers that are positive, too, and at most ``most``.

    Raises:
        PolicyError: If they are not.
    """
    found = array(value, what, shape)
    if not ((found > 0) & (found <= most)).all():
        raise PolicyError(f"metadata: {what} must be positive" + (f", and at most {most:g}" if most < math.inf else ""))
    return found


def bounds(value: Any, what: str, size: int, open_end: float) -> tuple[float, ...]:
    """Return ``size`` numbers of which null means ``open_end``, an infinity; JSON has none. Empty stays empty.

    Raises:
        PolicyError: If they are something else.
    """
    if value == []:
        return ()
    found = array(value, what, (size,), null=True)
    return tuple(np.where(np.isnan(found), open_end, found).tolist())


def _all_numbers(value: Any, null: bool) -> bool:
    if isinstance(value, list):
        return all(_all_numbers(each, null) for each in value)
    return (null and value is None) or (isinstance(value, int | float) and not isinstance(value, bool))
