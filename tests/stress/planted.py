"""An engine with a cliff: robots whose links are twice as heavy as described do not move."""

import numpy as np

from physai.physics import RobotState
from physai.physics.pybullet import PyBulletPhysics


class Cliff(PyBulletPhysics):
    def step(self, command: np.ndarray) -> RobotState:
        mass = self.parameters()["link_mass"]
        heavy = mass[:, 0] > 2.0 * self._spec.link_mass[0]
        return super().step(np.where(heavy[:, None], 0.0, command))
