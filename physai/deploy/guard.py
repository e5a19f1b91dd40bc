"""The collision guard: motion that would bring the arm too close to itself, or to what stands around, is held back."""

from collections.abc import Callable

import numpy as np

from physai.collision import Box, CollisionModel
from physai.deploy.metadata import Metadata
from physai.deploy.parameters import ControllerConfig
from physai.errors import UserError

_NUMBERS = 6  # of a box: x, y, z of its centre, then half of its edges
_ROUNDING = 1e-6  # m
_STEP = 1e-4  # rad, over which slopes are taken
_SPARE = 5e-4  # m, that an arm keeps more while it slides past something: the way there is not quite straight
_APART = 0.005  # m/s, at which what is too close goes apart then
_PROJECTIONS = 8
_LITTLE = 0.1  # of the motion that is wanted: where less is left, an arm stands
_SLOW = 0.25  # of max_velocity, at which it slides

Limited = Callable[[np.ndarray], tuple[np.ndarray, str | None]]  # see VelocityLimits.apply


class CollisionGuard:
    """Looks ahead by the time that the arm needs to stop.

    A motion that would bring two things too close is replaced by the nearest one that slides past, as control barrier
    functions do (Ames et al., ECC 2019); and that is looked at once more. Where little is left of it, the arm stands.

    Args:
        metadata: Has the capsules of the robot, where it has any; without them nothing is held back.
        config: ``collision_margin``, ``stopping_time``, ``max_velocity``, ``floor`` and ``boxes`` are used.

    Raises:
        UserError: If ``floor`` or ``boxes`` are not what they should be, or cannot be looked at without capsules.
    """

    def __init__(self, metadata: Metadata, config: ControllerConfig) -> None:
        self._time, self._slow = config.stopping_time, _SLOW * config.max_velocity
        self.model = self._around(metadata.collision, config)
        self._margin = np.empty(0) if self.model is None else self._margins(self.model, metadata.home, config)
        self._steps = _STEP * np.eye(len(metadata.home))

    def apply(
        self, velocity: np.ndarray, position: np.ndarray, limited: Limited
    ) -> tuple[np.ndarray | None, str | None]:
        """Return the velocities [n], rad/s, that may be commanded, None to stand; and what would come too close.

        Args:
            velocity: What is wanted, rad/s.
            position: Where the joints are, rad.
            limited: Brings other velocities within the limits that hold now.
        """
        if self.model is None:
            return velocity, None
        # All at once: slopes are seldom needed, but hardly cost more in the same call.
        ways = np.vstack([np.zeros_like(position), velocity * self._time, self._steps])
        now, after, *stepped = self.model.distance(position + ways)
        if (nearing := self._nearing(now, after)) is None:
            return velocity, None
        past = self._past(velocity, now, (np.array(stepped) - now).T / _STEP)
        if past @ velocity < _LITTLE * (velocity @ velocity):
            return None, nearing
        past, _ = limited(past * min(1.0, self._slow / np.abs(past).max()))
        after = self.model.distance((position + past * self._time)[np.newaxis])[0]
        return (past if self._nearing(now, after) is None else None), nearing

    def _nearing(self, now: np.ndarray, after: np.ndarray) -> str | None:
        """Name what comes too close between two times, of their P distances, m. What is so already may go apart."""
        assert self.model is not None
        too_close = np.where((after < self._margin) & (after < now - _ROUNDING), after, np.inf)
        worst = int(too_close.argmin())
        if too_close[worst] == np.inf:
            return None
        first, second = self.model.names[worst]
        return f"'{first}' would come within {max(after[worst], 0.0):.3f} m of '{second}'"

    def _past(self, velocity: np.ndarray, distance: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Return the velocities nearest to these that bring nothing too close, as far as distances change evenly.

        What is not kept is met one after the other, the worst one first (Kaczmarz, 1937).

        Args:
            velocity: What is wanted, rad/s, [n].
            distance: m, [P].
            slope: By how much it changes, m/rad, [P, n].
        """
        least = np.minimum((self._margin + _SPARE - distance) / self._time, _APART)  # to go apart by, m/s, [P]
        for _ in range(_PROJECTIONS):
            short = least - slope @ velocity
            worst = int(short.argmax())
            if short[worst] <= 0.0:
                break
            row = slope[worst]
            velocity = velocity + row * (short[worst] / max(row @ row, _ROUNDING))
        return velocity

    def inside(self, point: np.ndarray) -> str | None:
        """Name what a point in the base frame [3], m, lies in, and the arm cannot: its base, the floor or a box."""
        return None if self.model is None else self.model.inside(point)

    @staticmethod
    def _margins(model: CollisionModel, home: np.ndarray, config: ControllerConfig) -> np.ndarray:
        """How close each of the P pairs may come, m, [P]: ``collision_margin``.

        Links that are neighbours but one are hardly ever farther apart than that. They may lose half of what they keep
        at home.
        """
        margins = np.full(len(model.names), config.collision_margin)
        of_links = slice(0, len(model.pairs))
        at_home = model.distance(home[np.newaxis])[0, of_links]
        margins[of_links] = np.minimum(margins[of_links], np.maximum(0.5 * at_home, 0.0))
        return margins

    @staticmethod
    def _around(model: CollisionModel | None, config: ControllerConfig) -> CollisionModel | None:
        if model is None:
            if config.floor or config.boxes:
                raise UserError(
                    "floor, boxes: the policy file has no capsules of its robot, so nothing can be looked at"
                )
            return None
        if len(config.floor) > 1:
            raise UserError(f"floor: one height is needed, or none, got {list(config.floor)}")
        if len(config.boxes) % _NUMBERS:
            raise UserError(f"boxes: {_NUMBERS} numbers a box are needed, got {len(config.boxes)}")
        rows = [config.boxes[start : start + _NUMBERS] for start in range(0, len(config.boxes), _NUMBERS)]
        try:
            boxes = [Box(f"box {row}", (x, y, z), (a, b, c)) for row, (x, y, z, a, b, c) in enumerate(rows, 1)]
        except ValueError as error:
            raise UserError(f"boxes: {error}") from error
        return model.within(config.floor[0] if config.floor else model.floor, (*model.boxes, *boxes))
