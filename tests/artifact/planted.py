"""Engines whose arms do otherwise than their description says."""

from collections import deque

import numpy as np

from physai.physics import DynamicsParameters, RobotState
from physai.physics.mujoco import MuJoCoPhysics


class Flipped(MuJoCoPhysics):
    """The last joint turns the other way."""

    def step(self, command: np.ndarray) -> RobotState:
        return super().step(np.concatenate([command[:, :-1], -command[:, -1:]], axis=1))


class Swapped(MuJoCoPhysics):
    """The first two joints are connected the wrong way round."""

    def step(self, command: np.ndarray) -> RobotState:
        return super().step(command[:, [1, 0, *range(2, command.shape[1])]])


class Late(MuJoCoPhysics):
    """Commands take three steps more."""

    def reset(self, rows: np.ndarray, state: RobotState, parameters: DynamicsParameters | None = None) -> None:
        super().reset(rows, state, parameters)
        if not hasattr(self, "_line"):
            self._line = deque(np.zeros((3, *self._position.shape)), maxlen=3)
        for command in self._line:
            command[rows] = 0.0

    def step(self, command: np.ndarray) -> RobotState:
        arrives = self._line[0]
        self._line.append(command.copy())
        return super().step(arrives)


class Weak(MuJoCoPhysics):
    """Motors have half the effort that they should have."""

    def reset(self, rows: np.ndarray, state: RobotState, parameters: DynamicsParameters | None = None) -> None:
        if parameters is not None:
            parameters = parameters | {"effort_limit": 0.5 * parameters["effort_limit"]}
        super().reset(rows, state, parameters)
