"""The smallest engine there can be: joints without mass that follow their commands at once."""

import numpy as np

from physai.physics import DynamicsParameters, RobotState, nominal_dynamics
from physai.robots import RobotSpec
from physai.signals import Quantity


class DummyPhysics:
    """N robots whose joints do what they are told, as fast as they may; see :class:`physai.physics.Physics`."""

    simulated = True

    def __init__(self, spec: RobotSpec, num_robots: int, control_dt: float, substeps: int = 1) -> None:
        self.num_robots = num_robots
        self._spec, self._dt = spec, control_dt
        self._position = np.tile(spec.home, (num_robots, 1))
        self._velocity = np.zeros_like(self._position)
        self._parameters = {key: np.repeat(value, num_robots, axis=0) for key, value in nominal_dynamics(spec).items()}

    def reset(self, rows: np.ndarray, state: RobotState, parameters: DynamicsParameters | None = None) -> None:
        self._position, self._velocity = self._position.copy(), self._velocity.copy()
        self._position[rows], self._velocity[rows] = state.joint_position, state.joint_velocity
        for key, value in (parameters or {}).items():
            self._parameters[key][rows] = value

    def step(self, command: np.ndarray) -> RobotState:
        takes_positions = self._spec.command is Quantity.JOINT_POSITION
        wanted = (command - self._position) / self._dt if takes_positions else command
        self._velocity = np.clip(wanted, -self._spec.velocity_limit, self._spec.velocity_limit)
        self._position = self._position + self._dt * self._velocity
        return self.robot_state()

    def robot_state(self) -> RobotState:
        return RobotState(self._position.copy(), self._velocity.copy())

    def parameters(self) -> DynamicsParameters:
        return {key: value.copy() for key, value in self._parameters.items()}

    def state(self) -> dict[str, np.ndarray]:
        return {"joint_position": self._position, "joint_velocity": self._velocity, **self.parameters()}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        self._position, self._velocity = state["joint_position"], state["joint_velocity"]
        self._parameters = {key: state[key].copy() for key in self._parameters}

    def close(self) -> None:
        pass
