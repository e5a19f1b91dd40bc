"""Distances of segments, each given by its centre, direction and half length, for many at a time."""

import numpy as np

_PARALLEL = 1e-12  # sin² of an angle below which two directions count as one


def dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Scalar products of vectors [3, ...]."""
    product = first * second
    result = product[0]
    result += product[1]
    result += product[2]
    return result


def between_segments(
    way: np.ndarray, first: np.ndarray, second: np.ndarray, first_half: np.ndarray, second_half: np.ndarray
) -> np.ndarray:
    """Return how far segments are from each other, m; 0 where they cross.

    The nearest points of the two lines are taken first, then moved into the segments one after the other (C. Ericson,
    Real-Time Collision Detection, 2005, chapter 5.1.9). Exact, but for rounding: some 1e-8 m where they cross.

    Args:
        way: From the centre of the second to that of the first, m, [3, P, N].
        first: Unit direction of the first, [3, P, N].
        second: Unit direction of the second, [3, P, N].
        first_half: Half the length of the first, m, [P, 1].
        second_half: Half the length of the second, m, [P, 1].

    Returns:
        [P, N].
    """
    alike, along_first, along_second = dot(first, second), dot(first, way), dot(second, way)
    across = 1.0 - alike * alike
    np.maximum(across, _PARALLEL, out=across)
    on_first = alike * along_second
    on_first -= along_first
    on_first /= across
    _clip(on_first, first_half)
    on_second = alike * on_first
    on_second += along_second
    _clip(on_second, second_half)
    np.multiply(alike, on_second, out=on_first)
    on_first -= along_first
    _clip(on_first, first_half)
    # |way + s first - t second|² = |way|² + s (s + 2 way·first) + t (t - 2 way·second - 2 s first·second)
    alike *= on_first
    alike += along_second
    alike *= -2.0
    alike += on_second
    alike *= on_second
    along_first *= 2.0
    along_first += on_first
    along_first *= on_first
    alike += along_first
    alike += dot(way, way)
    np.maximum(alike, 0.0, out=alike)
    return np.sqrt(alike, out=alike)


def from_boxes(center: np.ndarray, direction: np.ndarray, half: np.ndarray, half_size: np.ndarray) -> np.ndarray:
    """Return how far segments are from boxes, m; 0 where they reach into them.

    The squared distance of a point that moves along a segment is convex, and quadratic between the places where it
    crosses a plane of one of the box's faces. So its slope is known everywhere from its values at these places and at
    the ends, and the place where it is zero lies between two of them. Exact, but for rounding.

    Args:
        center: Of the segments, from the centres of the boxes, m, [3, P, N].
        direction: Unit directions, [3, P, N].
        half: Half their lengths, m, [P, 1].
        half_size: Half the edges of the boxes, m, [3, P, 1].

    Returns:
        [P, N].
    """
    moving = np.where(np.abs(direction) > _PARALLEL, direction, 1.0)
    places = [(side * half_size - center) / moving for side in (-1.0, 1.0)]
    candidates = np.concatenate([*places, np.broadcast_to(half, (2, *center.shape[1:])) * [[[-1.0]], [[1.0]]]])
    _clip(candidates, half)  # [8, P, N]
    offset = center[:, np.newaxis] + direction[:, np.newaxis] * candidates  # [3, 8, P, N]
    slope = dot(direction[:, np.newaxis], _outside(offset, half_size[:, np.newaxis]))  # [8, P, N]
    falling, rising = slope <= 0, slope >= 0
    before = np.where(falling, candidates, -half).max(axis=0)
    after = np.where(rising, candidates, half).min(axis=0)
    fall = np.where(falling, slope, -np.inf).max(axis=0)
    rise = np.where(rising, slope, np.inf).min(axis=0)
    bracketed = np.isfinite(fall) & np.isfinite(rise) & (rise > fall)
    step = np.zeros_like(before)
    np.divide(-fall, rise - fall, out=step, where=bracketed)
    place = np.where(np.isfinite(fall), before + step * (after - before), -half)
    nearest = _outside(center + direction * place, half_size)
    return np.sqrt(dot(nearest, nearest))


def _outside(offset: np.ndarray, half_size: np.ndarray) -> np.ndarray:
    """From the nearest point of a box to a point, both from its centre."""
    return offset - np.clip(offset, -half_size, half_size)


def _clip(values: np.ndarray, limit: np.ndarray) -> None:
    np.minimum(values, limit, out=values)
    np.maximum(values, -limit, out=values)
