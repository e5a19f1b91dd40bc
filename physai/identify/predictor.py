"""What robots with other parameters would have done with the commands of a recording."""

import math
from typing import Any

import numpy as np

from physai.identify.trials import Trials
from physai.physics import ParameterLayout, Physics, RobotState
from physai.robots import RobotSpec
from physai.targets import make


class Predictor:
    """Lets robots with other parameters do what a real one did.

    Args:
        spec: The robot.
        physics: The engine, as ``conf/physics`` names one.
        control_dt: Of its env, s; the engine steps at the period of the recording.
        trials: What it did, B motions.
    """

    def __init__(self, spec: RobotSpec, physics: dict[str, Any], control_dt: float, trials: Trials) -> None:
        self._spec, self._config, self._trials = spec, physics, trials
        self.per_control_step = control_dt / trials.period
        self._layout = ParameterLayout(spec)
        self.effort_limit = self._layout.columns["effort_limit"]
        self._made: dict[int, Physics] = {}

    def __call__(self, parameters: np.ndarray, delay: float, start: np.ndarray, motions: np.ndarray) -> np.ndarray:
        """Map ``physics_parameters`` [R, P] to what sensors would have said, [R, 3, T, M, n].

        Args:
            parameters: Of R robots, each of which makes all the motions asked for.
            delay: Of their actuators, steps of the recording; of a fraction, a step feels the mean of two commands.
            start: What the encoders say when the motions begin, rad, [R, M, n].
            motions: Numbers of the motions, [M].
        """
        trials, rows, joints = self._trials, len(parameters), start.shape[2]
        robots = rows * len(motions)
        if robots not in self._made:
            needs = ("reset", "step", "close")
            made: Physics = make("physics", self._config, self._spec, robots, trials.period, needs=needs)
            self._made[robots] = made
        physics = self._made[robots]
        each = np.repeat(parameters, len(motions), axis=0)
        offset = each[:, self._layout.columns["encoder_offset"]]
        true = start.reshape(robots, joints) - offset
        state = RobotState(true, np.tile(trials.velocity[motions], (rows, 1)))
        physics.reset(np.arange(robots), state, self._layout.dynamics(each, self.per_control_step))
        given = np.concatenate([np.repeat(trials.before[None], math.ceil(delay), axis=0), trials.command])[:, motions]
        late = math.ceil(delay) - delay  # of a step, in which the newer of two commands is in force
        arrives = given if late == 0.0 else (1.0 - late) * given[:-1] + late * given[1:]
        seen = np.empty((len(trials.command), 3, robots, joints))
        for step, now in enumerate(seen):
            state = physics.step(np.tile(arrives[step], (rows, 1)))
            now[0], now[1] = state.joint_position + offset, state.joint_velocity
            now[2] = 0.0 if state.joint_effort is None else state.joint_effort
        return seen.reshape(len(seen), 3, rows, len(motions), joints).transpose(2, 1, 0, 3, 4)

    def close(self) -> None:
        """Free the engines."""
        for physics in self._made.values():
            physics.close()
