"""The arm of the virtual robot, and the velocity controller below it; no ROS in here."""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
import torch

from physai.config import compose, conf_dir, nearest, validate
from physai.envs.simulation import EnvConfig
from physai.errors import UserError
from physai.physics import ParameterLayout, RandomizationConfig
from physai.physics.pybullet import PyBulletPhysics
from physai.robots import RobotSpec
from physai.seeding import derive


class VelocityController:
    """What ros2_control's JointGroupVelocityController does with commands, its dangers included.

    A command with a value that is not finite is dropped. One of a wrong length deactivates the controller: zero
    velocity, deaf until ``activate``. The last velocity holds for ever, unless there is a timeout.

    Args:
        joints: n.
        timeout: Seconds after which a command is over; 0 for never.
    """

    def __init__(self, joints: int, timeout: float = 0.0) -> None:
        self.timeout = timeout
        self._zeros = np.zeros(joints)
        self.activate()

    def activate(self) -> None:
        """Listen again, standing still."""
        self.active = True
        self._velocity, self._since = self._zeros, -math.inf

    def command(self, velocity: Sequence[float], now: float) -> None:
        """Take a command, rad/s, at a time, s."""
        if not self.active:
            return
        if len(velocity) != len(self._zeros):
            self._velocity, self.active = self._zeros, False
        elif np.isfinite(velocity).all():
            self._velocity, self._since = np.array(velocity, dtype=np.float64), now

    def velocity(self, now: float) -> np.ndarray:
        """Return what the motors are told now, [n] rad/s."""
        over = self.timeout > 0 and now - self._since > self.timeout
        return self._zeros if over else self._velocity


class VirtualArm:
    """One PyBullet arm as its sensors show it, with the dynamics, delay and sensor errors of a randomization config.

    Args:
        env: A file of ``conf/env``.
        randomization: A file of ``conf/randomization``.
        seed: Draws one robot from it.
        period: Time from step to step, s.

    Raises:
        UserError: If there is no such config.
    """

    def __init__(self, env: str, randomization: str, seed: int, period: float) -> None:
        for group, name in (("env", env), ("randomization", randomization)):
            files = [path.stem for path in (conf_dir() / group).glob("*.yaml")]
            if name not in files:
                raise UserError(f"{group}: no file '{name}' in conf/{group}{nearest(name, files)}")
        node = compose("train", [f"env={env}", f"randomization={randomization}"])
        config = validate(EnvConfig, node.env)
        draws = validate(RandomizationConfig, node.randomization)
        self.spec = RobotSpec.from_config(config.robot)
        self._physics = PyBulletPhysics(self.spec, 1, period)
        layout = ParameterLayout(self.spec)
        row = draws.sample(1, layout, torch.Generator().manual_seed(derive(seed, "virtual robot"))).numpy()
        self._dynamics = layout.dynamics(row)
        parameters = row[0].astype(np.float64)
        self._offset, self._position_noise, self._velocity_noise, delay = (
            parameters[layout.columns[name]]
            for name in ("encoder_offset", "position_noise", "velocity_noise", "actuator_delay")
        )
        self._delay = round(float(delay[0]) * config.control_dt / period)
        self._random = np.random.default_rng(derive(seed, "sensors"))
        self.reset()

    def reset(self) -> None:
        """Stand still at home."""
        n = len(self.spec.joints)
        self._commands = deque([np.zeros(n)] * (self._delay + 1), maxlen=self._delay + 1)
        self._physics.reset(np.zeros(1, dtype=int), self.spec.home[None], np.zeros((1, n)), self._dynamics)

    def step(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Hold velocities [n] rad/s for a period; return what the sensors say, rad [n] and rad/s [n]."""
        self._commands.append(velocity)
        position, speed = self._physics.step(self._commands[0][None])
        noise = self._random.standard_normal((2, len(velocity)))
        return (
            position[0] + self._offset + noise[0] * self._position_noise,
            speed[0] + noise[1] * self._velocity_noise,
        )

    def close(self) -> None:
        """Free the physics engine."""
        self._physics.close()
