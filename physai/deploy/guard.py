"""The collision guard: motion that would bring the arm too close to itself, or to what stands around, is held back."""

import numpy as np

from physai.collision import Box, CollisionModel
from physai.deploy.metadata import Metadata
from physai.deploy.parameters import ControllerConfig
from physai.errors import UserError

_NUMBERS = 6  # of a box: x, y, z of its centre, then half of its edges
_ROUNDING = 1e-6  # m


class CollisionGuard:
    """Looks ahead by the time that the arm needs to stop.

    Args:
        metadata: Has the capsules of the robot, where it has any; without them nothing is held back.
        config: ``collision_margin``, ``stopping_time``, ``floor`` and ``boxes`` are used.

    Raises:
        UserError: If ``floor`` or ``boxes`` are not what they should be, or cannot be looked at without capsules.
    """

    def __init__(self, metadata: Metadata, config: ControllerConfig) -> None:
        self._margin, self._time = config.collision_margin, config.stopping_time
        self.model = self._around(metadata.collision, config)

    def held_back(self, position: np.ndarray, velocity: np.ndarray) -> str | None:
        """Return what would come too close if the arm went on with velocities [n], rad/s, from positions [n], rad.

        What is too close already may go apart.
        """
        if self.model is None:
            return None
        before, after = self.model.distance(np.stack([position, position + velocity * self._time]))
        nearing = np.where((after < self._margin) & (after < before - _ROUNDING), after, np.inf)
        worst = int(nearing.argmin())
        if nearing[worst] == np.inf:
            return None
        first, second = self.model.names[worst]
        return f"'{first}' would come within {max(after[worst], 0.0):.3f} m of '{second}'"

    def inside(self, point: np.ndarray) -> str | None:
        """Name what a point in the base frame [3], m, lies in, and the arm cannot: its base, the floor or a box."""
        return None if self.model is None else self.model.inside(point)

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
