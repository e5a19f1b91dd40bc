"""The arm or the legs of the virtual robot, and the controller below; no ROS in here."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from physai.compose import compose, conf_dir
from physai.config import nearest, validate
from physai.envs.simulation import EnvConfig
from physai.errors import UserError
from physai.physics import ActuatorDelay, ParameterLayout, Physics, RandomizationConfig, RobotState, SensorErrors
from physai.physics.interface import at_home
from physai.physics.rotation import product, rotate_back, shortest
from physai.physics.sensing import ImuErrors
from physai.robots import RobotSpec
from physai.seeding import derive
from physai.signals import Quantity
from physai.targets import make


class GroupController:
    """What ros2_control's group controllers do with commands of joint velocities or positions, dangers included.

    A command with a value that is not finite is dropped. One of a wrong length deactivates the controller, which is
    deaf until ``activate``. The last command holds for ever, unless there is a timeout. A velocity controller stops
    when it is over or inactive; a position controller stays where it was sent to.

    Args:
        rest: What it commands at the start, [n]: zero velocities, or where the joints are.
        quantity: What commands are.
        timeout: Seconds after which a command is over; 0 for never.
    """

    def __init__(self, rest: np.ndarray, quantity: Quantity, timeout: float = 0.0) -> None:
        self.timeout = timeout
        self._rest, self._stops = rest, quantity is Quantity.JOINT_VELOCITY
        self.activate()

    def activate(self) -> None:
        """Listen again, at rest."""
        self.active = True
        self._command, self._since = self._rest, -math.inf

    def command(self, command: Sequence[float], now: float) -> None:
        """Take a command, rad/s or rad, at a time, s."""
        if not self.active:
            return
        if len(command) != len(self._rest):
            self.active = False
        elif np.isfinite(command).all():
            self._command, self._since = np.array(command, dtype=np.float64), now

    def value(self, now: float) -> np.ndarray:
        """Return what the motors are told now, [n] rad/s or rad."""
        over = not self.active or (self.timeout > 0 and now - self._since > self.timeout)
        return self._rest if over and self._stops else self._command


@dataclass(frozen=True)
class Base:
    """A base that floats: what it truly does, and what its IMU says.

    Attributes:
        pose: x, y, z in the world, m, then a quaternion x, y, z, w, [7].
        velocity: Along its own axes, m/s, [3].
        rate: About them, rad/s, [3].
        told_orientation: Quaternion, by the IMU, [4].
        told_rate: rad/s, by the IMU, [3].
    """

    pose: np.ndarray
    velocity: np.ndarray
    rate: np.ndarray
    told_orientation: np.ndarray
    told_rate: np.ndarray


class VirtualArm:
    """One simulated robot as its sensors show it, with the dynamics, delay and sensor errors of a randomization config.

    Args:
        env: A file of ``conf/env``, or the path of another.
        randomization: A file of ``conf/randomization``, or the path of another.
        seed: Draws one robot from it.
        period: Time from step to step, s.
        overrides: Hydra overrides such as ``env.robot.command=joint_position``.
        physics: A file of ``conf/physics``: its engine, also where the env brings one along.

    Attributes:
        effort: What its motors gave in the last step, N·m, [n].
        base: What a base that floats does; None of one that is fixed.

    Raises:
        UserError: If there is no such config.
    """

    def __init__(
        self,
        env: str,
        randomization: str,
        seed: int,
        period: float,
        overrides: Sequence[str] = (),
        physics: str = "pybullet",
    ) -> None:
        groups = {"env": env, "randomization": randomization, "physics": physics}
        for group, name in groups.items():
            files = [path.stem for path in (conf_dir() / group).glob("*.yaml")]
            if name not in files and not name.endswith(".yaml"):
                raise UserError(f"{group}: no file '{name}' in conf/{group}{nearest(name, files)}")
        node = compose("train", [*(f"{group}={name}" for group, name in groups.items()), *overrides])
        node.env.physics = node.physics
        config = validate(EnvConfig, node.env)
        if not config.simulated:
            raise UserError(f"physics: '{physics}' is no engine that could simulate a robot")
        draws = validate(RandomizationConfig, node.randomization)
        self.spec = RobotSpec.from_config(config.robot)
        substeps = max(1, math.ceil(config.substeps * period / config.control_dt - 1e-9))
        sizes = 1, period, substeps
        self._physics: Physics = make("physics", config.physics, self.spec, *sizes, needs=("reset", "step", "close"))
        layout = ParameterLayout(self.spec, config.ignored)
        draws.check(layout)
        self._parameters = draws.sample(1, layout, torch.Generator().manual_seed(derive(seed, "virtual robot")))
        self._dynamics = layout.dynamics(self._parameters.numpy(), config.control_dt / period)
        delay = float(self._parameters[0, layout.columns["actuator_delay"]])
        self._steps = np.array([round(delay * config.control_dt / period)])
        self._delay = ActuatorDelay(1, len(self.spec.joints))
        self._errors = SensorErrors(layout)
        self._imu = ImuErrors(layout) if self.spec.floating is not None else None
        self._random = torch.Generator().manual_seed(derive(seed, "sensors"))
        takes_positions = self.spec.command is Quantity.JOINT_POSITION
        self.rest = self.spec.home if takes_positions else np.zeros_like(self.spec.home)
        self.reset()

    def reset(self) -> None:
        """Stand still at home."""
        home, row = at_home(self.spec, 1), np.zeros(1, dtype=int)
        self._physics.reset(row, home, self._dynamics)
        self._delay.reset(row, self.rest[None], self._steps)
        self.effort = np.zeros_like(self.spec.home)
        self.base = self._base(home)

    def step(self, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Hold a command [n], rad/s or rad, for a period; return what the sensors say, rad [n] and rad/s [n]."""
        state = self._physics.step(self._delay(command[None]))
        true = torch.from_numpy(state.joint_position), torch.from_numpy(state.joint_velocity)
        position, velocity = self._errors(*true, self._parameters.double(), self._random)
        assert state.joint_effort is not None
        self.effort = state.joint_effort[0]
        self.base = self._base(state)
        return position[0].numpy(), velocity[0].numpy()

    def _base(self, state: RobotState) -> Base | None:
        if self._imu is None:
            return None
        assert state.base_pose is not None
        assert state.base_twist is not None
        turn, twist = state.base_pose[:, 3:], state.base_twist
        velocity, rate, down = (
            rotate_back(turn, vector) for vector in (twist[:, :3], twist[:, 3:], np.array([[0.0, 0.0, -1.0]]))
        )
        true = torch.from_numpy(rate), torch.from_numpy(down)
        told_rate, told_down = (each.numpy() for each in self._imu(*true, self._parameters.double(), self._random))
        told = product(turn, shortest(told_down, down))
        return Base(state.base_pose[0].copy(), velocity[0], rate[0], told[0], told_rate[0])

    def close(self) -> None:
        """Free the physics engine."""
        self._physics.close()
