"""An engine without physics: joints that do at once what they are told."""

import numpy as np

from physai.physics import RobotState, nominal_dynamics
from physai.signals import Quantity


class DummyPhysics:
    """N robots whose joints have no mass."""

    simulated = True

    def __init__(self, spec, num_robots, control_dt, substeps):
        self.num_robots, self._dt = num_robots, control_dt
        self._positions = spec.command is Quantity.JOINT_POSITION
        self._parameters = {key: np.repeat(value, num_robots, axis=0) for key, value in nominal_dynamics(spec).items()}
        self._position = np.tile(spec.home, (num_robots, 1))
        self._velocity = np.zeros_like(self._position)

    def reset(self, rows, state, parameters=None):
        self._position, self._velocity = self._position.copy(), self._velocity.copy()
        self._position[rows], self._velocity[rows] = state.joint_position, state.joint_velocity
        for key, value in (parameters or {}).items():
            self._parameters[key][rows] = value

    def step(self, command):
        self._velocity = (command - self._position) / self._dt if self._positions else command
        self._position = self._position + self._velocity * self._dt
        return self.robot_state()

    def robot_state(self):
        return RobotState(self._position, self._velocity)

    def parameters(self):
        return self._parameters

    def state(self):
        return {"position": self._position, "velocity": self._velocity}

    def set_state(self, state):
        self._position, self._velocity = state["position"], state["velocity"]

    def close(self):
        pass
