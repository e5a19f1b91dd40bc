"""Fitting capsules: the smallest that holds a set of points, and a few that hold the convex parts of a link."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

_CUTS = np.linspace(0.2, 0.8, 7)  # where a piece may be cut in two, as shares of its length
_TICKS = 20  # points along each edge of the grid by which space is measured


@dataclass(frozen=True, eq=False)
class Fitted:
    """A capsule around points.

    Attributes:
        start: m, [3].
        end: m, [3].
        radius: m.
    """

    start: np.ndarray
    end: np.ndarray
    radius: float

    @property
    def volume(self) -> float:
        """m³."""
        return _volume(float(np.linalg.norm(self.end - self.start)), self.radius)

    def outside(self, points: np.ndarray) -> np.ndarray:
        """How far points [V, 3] are from its surface, m, [V]; negative inside."""
        way = self.end - self.start
        share = np.clip((points - self.start) @ way / max(float(way @ way), 1e-18), 0.0, 1.0)
        return np.linalg.norm(points - self.start - share[:, np.newaxis] * way, axis=1) - self.radius


def smallest_capsule(points: np.ndarray) -> Fitted:
    """Return the capsule of the least volume that is found around points [V, 3], m; it holds all of them.

    For a given line and radius the least length is known, so five numbers are searched: the line and the radius.
    """
    best = _roughly(points)
    middle = points.mean(axis=0)
    for _ in range(2):
        u = _direction(best)
        v, w = _across(u)
        foot = 0.5 * (best.start + best.end) - middle

        def made(x: np.ndarray, u: np.ndarray = u, v: np.ndarray = v, w: np.ndarray = w) -> Fitted:
            along = u + x[0] * v + x[1] * w
            return _on_line(points, middle + x[2] * v + x[3] * w, along / np.linalg.norm(along), x[4])

        size = best.radius
        first = np.array([0.0, 0.0, foot @ v, foot @ w, 1.0])
        simplex = np.tile(first, (6, 1))
        simplex[1:] += np.diag([0.15, 0.15, 0.1 * size, 0.1 * size, 0.05])
        options = {"maxfev": 400, "initial_simplex": simplex, "xatol": 1e-5, "fatol": 1e-10}
        found = made(minimize(lambda x, made=made: made(x).volume, first, method="Nelder-Mead", options=options).x)
        if found.volume < best.volume:
            best = found
    return best


@dataclass(frozen=True, eq=False)
class Piece:
    """Convex parts, or what cuts have left of them, and a capsule that holds them.

    Attributes:
        parts: Corners of the parts, m, [V, 3] each.
        fitted: The capsule.
    """

    parts: list[np.ndarray]
    fitted: Fitted

    @classmethod
    def of(cls, parts: Sequence[np.ndarray]) -> "Piece":
        """Fit the smallest capsule."""
        return cls(list(parts), smallest_capsule(np.concatenate(parts)))

    def halves(self) -> list["Piece"]:
        """Cut it in two where the halves take least space, as far as rough capsules tell."""
        points = np.concatenate(self.parts)
        space = Space(points)
        tried: list[tuple[float, int, list[list[np.ndarray]]]] = []
        for normal in _normals(points, self.fitted):
            for place in _CUTS:
                slices = _slices(self.parts, normal, np.array([place]))
                rough = [_roughly(np.concatenate(part)) for part in slices]
                tried.append((space.taken(rough), len(tried), slices))
        return [Piece.of(parts) for parts in min(tried)[2]]

    def slices(self, count: int) -> list[list["Piece"]]:
        """Cut it in slices as thick as each other, in each of some directions."""
        normals = _normals(np.concatenate(self.parts), self.fitted)
        places = np.arange(1, count) / count
        return [[Piece.of(parts) for parts in _slices(self.parts, normal, places)] for normal in normals]


class Space:
    """Measures how much space capsules around points [V, 3] take together, m³, by a grid."""

    def __init__(self, points: np.ndarray) -> None:
        low, high = points.min(axis=0), points.max(axis=0)
        more = 0.3 * (high - low).max()
        ticks = [np.linspace(*ends, _TICKS) for ends in zip(low - more, high + more, strict=True)]
        self._grid = np.stack(np.meshgrid(*ticks), axis=-1).reshape(-1, 3)
        self._cell = float(np.prod([tick[1] - tick[0] for tick in ticks]))

    def taken(self, capsules: Sequence[Fitted]) -> float:
        """Count the cells within any of them."""
        return float(np.any([each.outside(self._grid) <= 0 for each in capsules], axis=0).sum()) * self._cell


def cut_one(whole: Piece, pieces: Sequence[Piece]) -> list[Piece]:
    """Cut that one of the pieces of a link in two that makes its capsules take least space together."""
    tried = [[*pieces[:row], *piece.halves(), *pieces[row + 1 :]] for row, piece in enumerate(pieces)]
    space = Space(np.concatenate(whole.parts))
    return min(tried, key=lambda each: space.taken([piece.fitted for piece in each]))


def _slices(parts: Sequence[np.ndarray], normal: np.ndarray, places: np.ndarray) -> list[list[np.ndarray]]:
    """Cut convex parts by planes at ``places``, which are shares of their length along ``normal``.

    Parts are cut with their corners. A capsule is convex, so it holds all of a slice whose corners it holds.
    """
    height = np.concatenate(parts) @ normal
    slices, rest = [], list(parts)
    for place in height.min() + places * np.ptp(height):
        cut = [_cut(part, normal, place) for part in rest]
        slices.append([below for below, _ in cut if len(below)])
        rest = [above for _, above in cut if len(above)]
    return [each for each in [*slices, rest] if each]


def _normals(points: np.ndarray, fitted: Fitted) -> list[np.ndarray]:
    """Directions across which it may be good to cut."""
    return [*_axes(points), _direction(fitted)]


def _cut(points: np.ndarray, normal: np.ndarray, place: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut the convex hull of points in two; return the corners below and above, none where nothing is."""
    height = points @ normal - place
    below, above = height <= 0, height >= 0
    if not below.any() or not above.any():
        return points[below], points[above]
    first, second = _edges(points).T
    crossing = height[first] * height[second] < 0
    first, second = first[crossing], second[crossing]
    share = (height[first] / (height[first] - height[second]))[:, np.newaxis]
    edge = points[first] + share * (points[second] - points[first])
    return np.concatenate([points[below], edge]), np.concatenate([points[above], edge])


def _edges(points: np.ndarray) -> np.ndarray:
    """Pairs of corners among which are all edges of the hull, [E, 2]."""
    try:
        faces = ConvexHull(points).simplices
    except (QhullError, ValueError):  # flat, or fewer than four: all pairs
        return np.stack(np.triu_indices(len(points), 1), axis=1)
    return np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


def _roughly(points: np.ndarray) -> Fitted:
    """Return the smallest capsule along one of the main axes of points."""
    return min(
        (_on_line(points, _circle_center(points, axis), axis, 1.0) for axis in _axes(points)),
        key=lambda fit: fit.volume,
    )


def _axes(points: np.ndarray) -> np.ndarray:
    """Return the main axes of points, and those of their frame, which designers like, [6, 3]."""
    return np.concatenate([np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2], np.eye(3)])


def _circle_center(points: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return about where a line along ``axis`` is least far from the farthest point (Badoiu and Clarkson, 2003)."""
    flat = points - np.outer(points @ axis, axis)
    center = flat.mean(axis=0)
    for step in range(1, 30):
        farthest = flat[np.argmax(np.einsum("ij,ij->i", flat - center, flat - center))]
        center = center + (farthest - center) / (step + 1)
    return center


def _on_line(points: np.ndarray, foot: np.ndarray, axis: np.ndarray, wider: float) -> Fitted:
    """Return the shortest capsule on a line through ``foot`` whose radius is ``wider`` times what is needed."""
    way = points - foot
    along = way @ axis
    beside = np.einsum("ij,ij->i", way, way) - along * along
    radius = max(1.0, wider) * float(np.sqrt(max(beside.max(), 0.0))) + 1e-9
    rise = np.sqrt(np.maximum(radius * radius - beside, 0.0))
    low, high = float((along + rise).min()), float((along - rise).max())
    if low > high:  # a sphere does
        low = high = 0.5 * (low + high)
    return Fitted(foot + low * axis, foot + high * axis, float(radius))


def _direction(fitted: Fitted) -> np.ndarray:
    way = fitted.end - fitted.start
    length = float(np.linalg.norm(way))
    return way / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def _across(axis: np.ndarray) -> np.ndarray:
    """Two unit vectors across a third, [2, 3]."""
    return np.linalg.svd(axis[np.newaxis])[2][1:]


def _volume(length: float, radius: float) -> float:
    return np.pi * radius * radius * (length + 4.0 / 3.0 * radius)
