"""Where goals lie: regions that are sampled in training and asked on a robot whether a goal is in them."""

import math
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np
import torch

_EDGE = 1e-6  # a goal on the very edge, written with fewer digits, is meant to be in


class Region(Protocol):
    """A set of goals of g numbers; its fields are plain numbers, so that a policy file can hold them.

    Attributes:
        kind: Its name in a policy file, a key of :data:`REGIONS`.
    """

    kind: ClassVar[str]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest value of each number, [g]."""

    def sample(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw goals [rows, g]."""

    def contains(self, goal: np.ndarray) -> bool:
        """Whether a finite goal [g] is in the region."""

    def project(self, goal: np.ndarray) -> np.ndarray | None:
        """Return the nearest goal in the region [g]; None where none is nearest."""

    def describe(self, goal: np.ndarray) -> str:
        """Say in words where a goal lies and where it should."""


@dataclass(frozen=True)
class Ring:
    """Points of the x-y plane between two distances from the origin of their frame.

    Attributes:
        inner: Smallest distance, m.
        outer: Largest distance, m.
    """

    kind: ClassVar[str] = "ring"
    inner: float
    outer: float

    def __post_init__(self) -> None:
        if not 0 <= self.inner <= self.outer < math.inf:
            raise ValueError(f"a ring needs an inner and a larger outer radius, not {self.inner} and {self.outer}")

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`Region`."""
        return np.full(2, -self.outer), np.full(2, self.outer)

    def sample(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw points: angle uniform in [0, 2π), radius uniform between the radii."""
        draw = torch.rand(rows, 2, generator=generator).numpy()
        angle = 2 * math.pi * draw[:, :1]
        radius = self.inner + (self.outer - self.inner) * draw[:, 1:]
        return radius * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)

    def contains(self, goal: np.ndarray) -> bool:
        """See :class:`Region`."""
        return self.inner - _EDGE <= math.hypot(*goal) <= self.outer + _EDGE

    def project(self, goal: np.ndarray) -> np.ndarray | None:
        """See :class:`Region`; no point is nearest to the centre, or to one whose distance is no number."""
        radius = math.hypot(*goal)
        if not _EDGE < radius < math.inf:
            return None
        return goal * (min(max(radius, self.inner), self.outer) / radius)

    def describe(self, goal: np.ndarray) -> str:
        """See :class:`Region`."""
        return f"{math.hypot(*goal):.3f} m from the base, not {self.inner:g} to {self.outer:g} m"


@dataclass(frozen=True)
class Ball:
    """Points in space within a distance of a centre.

    Attributes:
        center: x, y, z, m.
        radius: m.
    """

    kind: ClassVar[str] = "ball"
    center: tuple[float, ...]
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", tuple(self.center))
        if len(self.center) != 3 or not 0 < self.radius < math.inf or not all(map(math.isfinite, self.center)):
            raise ValueError(f"a ball needs a centre of three numbers and a radius, not {self.center}, {self.radius}")

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`Region`."""
        return np.array(self.center) - self.radius, np.array(self.center) + self.radius

    def sample(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw uniformly: a direction, and the cube root of a uniform number as the share of the radius."""
        draw = torch.rand(rows, 3, generator=generator, dtype=torch.float64).numpy()
        z, turn = 2 * draw[:, :1] - 1, 2 * math.pi * draw[:, 1:2]
        flat = np.sqrt(1 - z * z)
        direction = np.concatenate([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
        return np.array(self.center) + self.radius * np.cbrt(draw[:, 2:]) * direction

    def contains(self, goal: np.ndarray) -> bool:
        """See :class:`Region`."""
        return math.dist(goal, self.center) <= self.radius + _EDGE

    def project(self, goal: np.ndarray) -> np.ndarray | None:
        """See :class:`Region`; None where the distance is no number."""
        away = goal - np.array(self.center)
        distance = math.hypot(*away)
        if not distance < math.inf:
            return None
        return np.array(self.center) + away * min(1.0, self.radius / max(distance, _EDGE))

    def describe(self, goal: np.ndarray) -> str:
        """See :class:`Region`."""
        return f"{math.dist(goal, self.center):.3f} m from {list(self.center)}, not at most {self.radius:g} m"


@dataclass(frozen=True)
class Box:
    """Every number between two bounds.

    Attributes:
        low: Smallest values.
        high: Largest values.
    """

    kind: ClassVar[str] = "box"
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", tuple(self.low))
        object.__setattr__(self, "high", tuple(self.high))
        pairs = zip(self.low, self.high, strict=True)
        if not all(-math.inf < low <= high < math.inf for low, high in pairs):
            raise ValueError(f"a box needs lower and upper bounds, not {list(self.low)} and {list(self.high)}")

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`Region`."""
        return np.array(self.low), np.array(self.high)

    def sample(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw uniformly."""
        low, high = self.bounds
        draw = torch.rand(rows, len(low), generator=generator, dtype=torch.float64).numpy()
        return low + (high - low) * draw

    def contains(self, goal: np.ndarray) -> bool:
        """See :class:`Region`."""
        low, high = self.bounds
        return bool(((goal >= low - _EDGE) & (goal <= high + _EDGE)).all())

    def project(self, goal: np.ndarray) -> np.ndarray | None:
        """See :class:`Region`."""
        return np.clip(goal, *self.bounds)

    def describe(self, goal: np.ndarray) -> str:
        """See :class:`Region`."""
        low, high = self.bounds
        worst = int(np.maximum(low - goal, goal - high).argmax())
        return f"its number {worst + 1} is {goal[worst]:.3f}, not {low[worst]:g} to {high[worst]:g}"


@dataclass(frozen=True)
class Reachable:
    """Goals that the robot was seen to reach, within bounds.

    Whether it reaches any other within them is not known before it tries.

    Attributes:
        low: Smallest values.
        high: Largest values.
        examples: Goals, one after the other, as many numbers each as there are bounds.
    """

    kind: ClassVar[str] = "reachable"
    low: tuple[float, ...]
    high: tuple[float, ...]
    examples: tuple[float, ...] = field(repr=False)

    def __post_init__(self) -> None:
        box = Box(self.low, self.high)
        if not self.examples or len(self.examples) % len(self.low):
            raise ValueError(f"{len(self.examples)} numbers are no examples of {len(self.low)} each")
        if not all(map(box.contains, self._examples)):
            raise ValueError("an example is not within the bounds")

    @property
    def _examples(self) -> np.ndarray:
        return np.array(self.examples).reshape(-1, len(self.low))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`Region`."""
        return np.array(self.low), np.array(self.high)

    def sample(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw among the examples."""
        examples = self._examples
        return examples[torch.randint(len(examples), (rows,), generator=generator).numpy()]

    def contains(self, goal: np.ndarray) -> bool:
        """See :class:`Region`."""
        return Box(self.low, self.high).contains(goal)

    def project(self, goal: np.ndarray) -> np.ndarray | None:
        """See :class:`Region`."""
        return Box(self.low, self.high).project(goal)

    def describe(self, goal: np.ndarray) -> str:
        """See :class:`Region`."""
        return Box(self.low, self.high).describe(goal)


REGIONS: dict[str, type[Ring] | type[Ball] | type[Box] | type[Reachable]] = {
    region.kind: region for region in (Ring, Ball, Box, Reachable)
}
"""By the name that a policy file uses."""
