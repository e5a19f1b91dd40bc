"""What can touch what on a robot, how far apart it is, and the plain numbers that a policy file holds of it."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from physai.collision.capsules import Box, Capsule, check_numbers
from physai.collision.frames import Motions
from physai.collision.segments import between_segments, from_boxes

_BLOCK = 4096  # distances at a time: larger arrays leave the processor's cache, and each is asked of the system anew


@dataclass(frozen=True, eq=False)
class CollisionModel:
    """The capsules of a robot and what stands around it.

    Attributes:
        motions: Of the n driven joints.
        capsules: The shapes of the links.
        pairs: Indices of capsules that can meet.
        floor: Height of the floor in the base frame, m; None where there is none.
        boxes: What else stands around. Capsules that a joint moves must meet neither these nor the floor.

    Raises:
        ValueError: If an index is out of range, a pair is named twice or on one body, or a number is not finite.
    """

    motions: Motions
    capsules: tuple[Capsule, ...]
    pairs: tuple[tuple[int, int], ...]
    floor: float | None = None
    boxes: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        for capsule in self.capsules:
            if capsule.body > len(self.motions):
                bodies = f"bodies 0 to {len(self.motions)}"
                raise ValueError(f"capsule of '{capsule.link}': there are {bodies}, not {capsule.body}")
        known = range(len(self.capsules))
        for pair in self.pairs:
            whole = all(isinstance(each, int) and not isinstance(each, bool) for each in pair)
            if len(pair) != 2 or not whole or not all(each in known for each in pair):
                raise ValueError(f"pairs: {list(pair)} must be two indices of the {len(known)} capsules")
            first, second = (self.capsules[each] for each in pair)
            if first.body == second.body:
                raise ValueError(f"pairs: '{first.link}' and '{second.link}' of {list(pair)} are on the same body")
        if len({frozenset(pair) for pair in self.pairs}) < len(self.pairs):
            raise ValueError("pairs: one is named twice")
        if self.floor is not None:
            check_numbers("the model", "floor", [self.floor], count=1)

    def within(self, floor: float | None = None, boxes: Iterable[Box] = ()) -> "CollisionModel":
        """Return the same robot with other surroundings."""
        return dataclasses.replace(self, floor=floor, boxes=tuple(boxes))

    @functools.cached_property
    def names(self) -> tuple[tuple[str, str], ...]:
        """What the P distances are between, for messages: two links, or a link and the floor or a box."""
        moving = [capsule.link for capsule in self.capsules if capsule.body]
        around = ([] if self.floor is None else ["floor"]) + [box.name for box in self.boxes]
        of_links = [(self.capsules[first].link, self.capsules[second].link) for first, second in self.pairs]
        return (*of_links, *((link, other) for other in around for link in moving))

    def distance(self, joint_position: np.ndarray) -> np.ndarray:
        """Return how far apart what can meet is.

        Where the axis of a capsule meets that of another, or a box, the distance is that of surfaces that overlap by
        their radii: it grows no more negative.

        Args:
            joint_position: rad, [N, n].

        Returns:
            Between surfaces, m, negative where they overlap, [N, P]; ``names`` says between what. Of a joint position
            that is not finite they may be NaN, which is not below zero either: ask for finite ones first.
        """
        distance = np.empty((len(joint_position), len(self.names)))
        block = max(8, _BLOCK // max(len(self.names), 16))
        for begin in range(0, len(joint_position), block):
            rows = slice(begin, begin + block)
            distance[rows] = self._shapes.distance(self.motions.frames(joint_position[rows])).T
        return distance

    def inside(self, point: np.ndarray) -> str | None:
        """Name what stands still and holds a point in the base frame [3], m: a link of the base, the floor or a box."""
        for capsule in self.capsules:
            start, way = np.array(capsule.start), np.array(capsule.end) - np.array(capsule.start)
            along = np.clip((point - start) @ way / max(way @ way, 1e-12), 0.0, 1.0)
            if not capsule.body and np.linalg.norm(point - start - along * way) < capsule.radius:
                return capsule.link
        if self.floor is not None and point[2] < self.floor:
            return "floor"
        held = (box.name for box in self.boxes if (np.abs(point - np.array(box.center)) < box.half_size).all())
        return next(held, None)

    def describe(self) -> dict[str, Any]:
        """Return plain numbers, texts and lists, as JSON holds them."""
        return {
            "motions": {key: getattr(self.motions, key).tolist() for key in ("constant", "cosine", "sine")},
            "capsules": [_plain(capsule) for capsule in self.capsules],
            "pairs": [list(pair) for pair in self.pairs],
            "floor": self.floor,
            "boxes": [_plain(box) for box in self.boxes],
        }

    @classmethod
    def from_description(cls, described: Mapping[str, Any]) -> "CollisionModel":
        """Rebuild what :meth:`describe` returned, perhaps after a way through a file.

        Raises:
            ValueError: If something is missing, unknown or no such thing; it says what.
        """
        given = _fields(described, "collision", ("motions", "capsules", "pairs", "floor", "boxes"))
        for key in ("capsules", "pairs", "boxes"):
            if not isinstance(given[key], list):
                raise ValueError(f"collision: {key} must be a list")
        if not all(isinstance(pair, list) for pair in given["pairs"]):
            raise ValueError("collision: each of the pairs must be a list of two indices")
        return cls(
            Motions(**_fields(given["motions"], "motions", ("constant", "cosine", "sine"))),
            tuple(_made(Capsule, each, f"capsules[{row}]") for row, each in enumerate(given["capsules"])),
            tuple(tuple(pair) for pair in given["pairs"]),
            given["floor"],
            tuple(_made(Box, each, f"boxes[{row}]") for row, each in enumerate(given["boxes"])),
        )

    @functools.cached_property
    def _shapes(self) -> "_Shapes":
        return _Shapes(self)


class _Shapes:
    """The numbers of a model as arrays, robots last."""

    def __init__(self, model: CollisionModel) -> None:
        start, end = (
            np.array([getattr(each, key) for each in model.capsules], dtype=np.float64).reshape(-1, 3)
            for key in ("start", "end")
        )
        half = 0.5 * np.linalg.norm(end - start, axis=1, keepdims=True)
        straight_up = np.array([0.0, 0.0, 1.0])  # of spheres, which have no direction
        direction = np.where(half > 0, 0.5 * (end - start) / np.where(half > 0, half, 1.0), straight_up)
        radius = np.array([[each.radius] for each in model.capsules]).reshape(-1, 1)
        self._body = np.array([each.body for each in model.capsules], dtype=int)
        self._center, self._direction = (
            np.ascontiguousarray(of.T)[:, :, np.newaxis] for of in (0.5 * (start + end), direction)
        )
        pairs = np.array(model.pairs, dtype=int).reshape(-1, 2)
        self._first, self._second = pairs.T
        self._halves = half[self._first], half[self._second]
        self._radii = radius[self._first] + radius[self._second]
        moving = np.flatnonzero(self._body)
        self._floor = model.floor
        self._moving, self._moving_half, self._moving_radius = moving, half[moving], radius[moving]
        self._near_boxes = np.tile(moving, len(model.boxes))
        box_center, box_half_size = (
            np.repeat(np.array([getattr(box, key) for box in model.boxes]).reshape(-1, 3), len(moving), axis=0)
            for key in ("center", "half_size")
        )
        self._box_center, self._box_half_size = box_center.T[:, :, np.newaxis], box_half_size.T[:, :, np.newaxis]
        self._box_half, self._box_radius = half[self._near_boxes], radius[self._near_boxes]

    def distance(self, frames: np.ndarray) -> np.ndarray:
        """Map the frames of the bodies, as :meth:`Motions.frames` returns them, to distances [P, N], m."""
        turn = [frames[:, :, column].take(self._body, axis=0).swapaxes(0, 1) for column in range(4)]  # [3, C, N] each
        center, direction = (turn[0] * x + turn[1] * y + turn[2] * z for x, y, z in (self._center, self._direction))
        center += turn[3]
        way = center.take(self._first, axis=1)
        way -= center.take(self._second, axis=1)
        first, second = (direction.take(which, axis=1) for which in (self._first, self._second))
        apart = between_segments(way, first, second, *self._halves)
        apart -= self._radii
        found = [apart]
        if self._floor is not None:
            lowest = center[2, self._moving] - np.abs(direction[2, self._moving]) * self._moving_half
            found.append(lowest - self._moving_radius - self._floor)
        if len(self._near_boxes):
            offset = center.take(self._near_boxes, axis=1) - self._box_center
            along = direction.take(self._near_boxes, axis=1)
            found.append(from_boxes(offset, along, self._box_half, self._box_half_size) - self._box_radius)
        return found[0] if len(found) == 1 else np.concatenate(found)


def _plain(shape: Capsule | Box) -> dict[str, Any]:
    fields = dataclasses.asdict(shape)
    return {key: list(value) if isinstance(value, tuple) else value for key, value in fields.items()}


def _made(kind: Any, described: Any, where: str) -> Any:
    given = _fields(described, where, tuple(field.name for field in dataclasses.fields(kind)))
    for key in ("link", "name"):
        if key in given and not isinstance(given[key], str):
            raise ValueError(f"{where}: {key} must be a text, not {given[key]!r}")
    return kind(**{key: tuple(value) if isinstance(value, list) else value for key, value in given.items()})


def _fields(described: Any, where: str, keys: tuple[str, ...]) -> Mapping[str, Any]:
    if not isinstance(described, Mapping) or set(described) != set(keys):
        came = sorted(map(str, described)) if isinstance(described, Mapping) else repr(described)[:80]
        raise ValueError(f"{where}: it must hold {', '.join(keys)}, not {came}")
    return described
