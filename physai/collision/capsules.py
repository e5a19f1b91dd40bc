"""The shapes that are checked: capsules that hold the links of a robot, and boxes that stand around it."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Capsule:
    """All points within a radius of a segment; its link lies in it.

    Attributes:
        link: Name of the link.
        body: What carries it: 0 is the base, k what the k-th driven joint moves.
        start: One end of the segment in that body's frame, m.
        end: The other, m; the same as ``start`` makes a sphere.
        radius: m.

    Raises:
        ValueError: If a number is not finite, the radius not positive or the body negative.
    """

    link: str
    body: int
    start: Point
    end: Point
    radius: float

    def __post_init__(self) -> None:
        where = f"capsule of '{self.link}'"
        check_numbers(where, "start", self.start)
        check_numbers(where, "end", self.end)
        check_numbers(where, "radius", [self.radius], count=1)
        if not self.radius > 0:
            raise ValueError(f"{where}: its radius must be positive, not {self.radius:g}")
        if not isinstance(self.body, int) or isinstance(self.body, bool) or self.body < 0:
            raise ValueError(f"{where}: its body must be a whole number from 0 on, not {self.body!r}")


@dataclass(frozen=True)
class Box:
    """A box that stands still, with faces along the axes of the base frame.

    Attributes:
        name: What it is, for messages.
        center: In the base frame, m.
        half_size: Half of its edges, m.

    Raises:
        ValueError: If a number is not finite or an edge not positive.
    """

    name: str
    center: Point
    half_size: Point

    def __post_init__(self) -> None:
        where = f"box '{self.name}'"
        check_numbers(where, "center", self.center)
        check_numbers(where, "half_size", self.half_size)
        if not min(self.half_size) > 0:
            raise ValueError(f"{where}: its half_size must be positive, not {list(self.half_size)}")


def check_numbers(where: str, key: str, values: Iterable[object], count: int = 3) -> None:
    """Check that there are ``count`` finite numbers.

    Raises:
        ValueError: Says where, which key and what came instead.
    """
    given = list(values) if isinstance(values, Sequence) else [values]
    numbers = [each for each in given if isinstance(each, int | float) and not isinstance(each, bool)]
    if len(given) != count or len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{where}: {key} must be {count} finite number{'s' * (count > 1)}, not {given}")
