"""Choosing the capsules of a robot, and the pairs of them that can meet, by what PyBullet's shapes say."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from physai.physics.shapes import ShapeCollisions
from physai.robots import RobotSpec, urdf
from physai.robots.capsules import Fitted, Piece, cut_one
from physai.robots.collision import CapsuleConfig, CollisionConfig, model
from physai.robots.shapes import collision_parts

_DIGITS = 4  # of metres, to which capsules are written
_FEW = 4000  # of the random configurations, by which capsules are chosen
_PAIR = 0.001  # the share of false alarms for which one more pair is worth its time
_NEVER_TOLD = 0.9  # share of the configurations in which shapes are apart; capsules that overlap in more tell nothing
_PATIENCE = 3  # cuts in a row that are no better, after which no more are tried


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
    capsule. Then again and again one of the two links that alarm falsely most often, or both, are cut into one more
    piece, each with its capsule, in the way for which their capsules overlap least where the shapes do not touch. Links
    whose capsules overlap nearly always, however they are cut, such as a base and the upper arm that turns closely
    beside it, are left out and named.

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
        close = distance.min(axis=0) < near
        self._touching = dict(zip(itertools.compress(judge.names, close), (distance[:, close] <= 0).T, strict=True))
        self._whole = {link: Piece.of(parts) for link, parts in self.parts.items()}
        self._sliced: dict[tuple[str, int], list[list[Piece]]] = {}

    def fit(self, false_alarms: float, most: int) -> tuple[CollisionConfig, Judged, dict[tuple[str, str], float]]:
        """Fit.

        Args:
            false_alarms: Share that is few enough.
            most: Number of capsules at most.

        Returns:
            What a robot's YAML holds; how it compares with the shapes in the configurations that it is made by; and the
            pairs of links that are left out, with the share of these configurations in which their shapes touch.
        """
        best = self._cut(false_alarms, most)
        untold = {pair: float(self._touching.pop(pair).mean()) for pair in best.untold}
        if untold:
            best = self._cut(false_alarms, most)
        whole = self._made(best.pieces, slice(None))
        return whole.config, whole.judged, untold

    def _cut(self, false_alarms: float, most: int) -> "_Made":
        few = slice(_FEW)
        best = made = self._made({link: [whole] for link, whole in self._whole.items()}, few)
        in_vain = 0
        while best.judged.false_alarms > false_alarms and made.count < most and in_vain < _PATIENCE:
            made = self._refined(made, few)
            better = made.cost < best.cost
            best, in_vain = (made, 0) if better else (best, in_vain + 1)
        return best

    def _refined(self, made: "_Made", rows: slice) -> "_Made":
        """Cut one of the two worst links, or both, into one more piece."""
        pieces, links = made.pieces, made.worst
        singles = []
        for link in links:
            tried = [self._made(pieces | {link: more}, rows) for more in self._more(link, pieces[link])]
            singles.append(min(tried, key=lambda one: one.depth))
        both = pieces | {link: single.pieces[link] for link, single in zip(links, singles, strict=True)}
        return min([*singles, self._made(both, rows)], key=lambda one: one.depth)

    def _more(self, link: str, pieces: list[Piece]) -> list[list[Piece]]:
        """Ways to cut a link into one more piece."""
        count = len(pieces) + 1
        if (link, count) not in self._sliced:
            self._sliced[link, count] = self._whole[link].slices(count)
        return [cut_one(self._whole[link], pieces), *self._sliced[link, count]]

    def _made(self, pieces: Mapping[str, list[Piece]], rows: slice) -> "_Made":
        capsules = [_capsule(link, each.fitted, self._skin) for link in pieces for each in pieces[link]]
        places: dict[str, list[int]] = {link: [] for link in pieces}
        for place, capsule in enumerate(capsules):
            places[capsule.link].append(place)
        pairs = [[a, b] for first, second in self._touching for a in places[first] for b in places[second]]
        distance = self._distance(CollisionConfig(capsules=capsules, pairs=pairs), rows)
        kept = np.flatnonzero(distance.min(axis=0) < self._near)
        config = CollisionConfig(capsules=capsules, pairs=[pairs[place] for place in kept])
        distance = distance[:, kept]
        touching = np.any([each[rows] for each in self._touching.values()] or [np.zeros(len(distance))], axis=0)
        nearest = distance.min(axis=1, initial=np.inf)
        judged = Judged.of(nearest <= 0, touching)
        wrong = ~touching & (nearest <= 0)
        worst = config.pairs[np.bincount(distance[wrong].argmin(axis=1)).argmax()] if wrong.any() else []
        depth = float(-np.where(wrong, nearest, 0.0).mean())
        links = np.array([[capsules[place].link for place in pair] for pair in config.pairs]).reshape(-1, 2)
        untold = []
        for pair, touches in self._touching.items():
            nearest = distance[:, (links == pair).all(axis=1)].min(axis=1, initial=np.inf)
            if (nearest[~touches[rows]] <= 0).mean() > _NEVER_TOLD:
                untold.append(pair)
        return _Made(dict(pieces), config, judged, depth, [capsules[place].link for place in worst], untold)

    def _distance(self, config: CollisionConfig, rows: slice) -> np.ndarray:
        spec = self._spec
        made = model(spec.urdf, self._robot, spec.linkage, spec.joints, config)
        return made.distance(self._joint_position[rows])


@dataclass(frozen=True)
class _Made:
    """Capsules so far.

    Attributes:
        depth: How deep they overlap where shapes do not touch, m.
        worst: Links that do most.
        untold: Pairs of links that nearly always do.
    """

    pieces: dict[str, list[Piece]]
    config: CollisionConfig
    judged: Judged
    depth: float
    worst: list[str]
    untold: list[tuple[str, str]]

    @property
    def cost(self) -> float:
        """False alarms, and the time that pairs take."""
        return self.judged.false_alarms + _PAIR * len(self.config.pairs)

    @property
    def count(self) -> int:
        """How many capsules."""
        return len(self.config.capsules)


def _capsule(link: str, fitted: Fitted, skin: float) -> CapsuleConfig:
    start, end = ((np.round(point, _DIGITS) + 0.0).tolist() for point in (fitted.start, fitted.end))
    unit = 10.0**-_DIGITS
    radius = (math.ceil((fitted.radius + skin) / unit) + 1) * unit  # one more: the ends are rounded
    return CapsuleConfig(link=link, start=start, end=end, radius=round(radius, _DIGITS))
