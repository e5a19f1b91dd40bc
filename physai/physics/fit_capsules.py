"""Choosing the capsules of a robot, and the pairs of them that can meet, by what PyBullet's shapes say."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from physai.physics.shapes import ShapeCollisions
from physai.robots import RobotSpec, urdf
from physai.robots.capsules import Fitted, Piece, cut_more
from physai.robots.collision import CapsuleConfig, CollisionConfig, model
from physai.robots.shapes import collision_parts

_DIGITS = 4  # of metres, to which capsules are written


@dataclass(frozen=True)
class Judged:
    """How capsules compare with shapes in random configurations.

    Attributes:
        touching: Share of the configurations in which shapes touch.
        missed: Share of these in which no capsules do.
        false_alarms: Share of the others in which capsules do.
    """

    touching: float
    missed: float
    false_alarms: float

    @classmethod
    def of(cls, alarm: np.ndarray, touching: np.ndarray) -> "Judged":
        """Compare two answers for the same configurations, [N] each."""
        share = float(touching.mean())
        missed = float((touching & ~alarm).mean()) / max(share, 1e-12)
        return cls(share, missed, float((alarm & ~touching).mean()) / max(1.0 - share, 1e-12))


class CapsuleFit:
    """Fits capsules to the links of a robot until few configurations alarm falsely.

    Pairs are chosen as MoveIt's set-up assistant makes its allowed collision matrix: by random configurations. Links
    that a joint joins, that touch always, or that never come near each other are left out. Each link begins with one
    capsule; then again and again that link gets one more for which most false alarms go.

    Args:
        spec: The robot.
        samples: Number of random configurations.
        near: What never comes as near as this cannot meet, m.
        skin: By how much capsules are larger than the shapes, m.
        seed: Of the configurations.

    Raises:
        UserError: If the URDF has no shapes, or one that cannot be read.
    """

    def __init__(self, spec: RobotSpec, samples: int, near: float, skin: float, seed: int) -> None:
        self._spec, self._near, self._skin = spec, near, skin
        self.parts = collision_parts(spec.urdf)
        self._robot = urdf.load(spec.urdf)
        self._joint_position = spec.sample(samples, np.random.default_rng(seed))
        judge = ShapeCollisions(spec)
        try:
            distance = judge.distance(self._joint_position, within=near)
        finally:
            judge.close()
        self._touching = (distance <= 0).any(axis=1)
        self._pairs = [pair for pair, least in zip(judge.names, distance.min(axis=0), strict=True) if least < near]
        self._pieces = {(link, 1): [Piece.of(parts)] for link, parts in self.parts.items()}

    def fit(self, false_alarms: float, most: int) -> tuple[CollisionConfig, Judged]:
        """Fit.

        Args:
            false_alarms: Share that is few enough.
            most: Number of capsules at most.

        Returns:
            What a robot's YAML holds, and how it compares with the shapes in the configurations that it is made by.
        """
        made = self._made(dict.fromkeys(self.parts, 1))
        while made.judged.false_alarms > false_alarms and sum(made.counts.values()) < most:
            tried = [self._made(made.counts | {link: made.counts[link] + 1}) for link in made.worst]
            made = min(tried, key=lambda one: one.depth)
        return made.config, made.judged

    def _made(self, counts: Mapping[str, int]) -> "_Made":
        capsules = [
            _capsule(link, each.fitted, self._skin) for link in counts for each in self._cut(link, counts[link])
        ]
        places: dict[str, list[int]] = {link: [] for link in counts}
        for place, capsule in enumerate(capsules):
            places[capsule.link].append(place)
        pairs = [[a, b] for first, second in self._pairs for a in places[first] for b in places[second]]
        distance = self._distance(CollisionConfig(capsules=capsules, pairs=pairs))
        kept = np.flatnonzero(distance.min(axis=0) < self._near)
        config = CollisionConfig(capsules=capsules, pairs=[pairs[place] for place in kept])
        distance = distance[:, kept]
        free = distance[~self._touching]
        deepest = distance.argmin(axis=1)[~self._touching & (distance.min(axis=1) <= 0)]
        worst = config.pairs[np.bincount(deepest, minlength=1).argmax()]
        judged = Judged.of((distance <= 0).any(axis=1), self._touching)
        depth = float(np.maximum(-free.min(axis=1), 0.0).mean())
        return _Made(dict(counts), config, judged, depth, [capsules[place].link for place in worst])

    def _cut(self, link: str, count: int) -> list[Piece]:
        if (link, count) not in self._pieces:
            self._pieces[link, count] = cut_more(self._cut(link, 1)[0], self._cut(link, count - 1))
        return self._pieces[link, count]

    def _distance(self, config: CollisionConfig) -> np.ndarray:
        spec = self._spec
        made = model(spec.urdf, self._robot, spec.chain, spec.joints, config)
        return made.distance(self._joint_position)


@dataclass(frozen=True)
class _Made:
    """Capsules so far; ``depth`` is how deep they overlap where shapes do not touch, m, and ``worst`` links do most."""

    counts: dict[str, int]
    config: CollisionConfig
    judged: Judged
    depth: float
    worst: list[str]


def _capsule(link: str, fitted: Fitted, skin: float) -> CapsuleConfig:
    start, end = (np.round(point, _DIGITS).tolist() for point in (fitted.start, fitted.end))
    unit = 10.0**-_DIGITS
    radius = (math.ceil((fitted.radius + skin) / unit) + 1) * unit  # one more: the ends are rounded
    return CapsuleConfig(link=link, start=start, end=end, radius=round(radius, _DIGITS))
