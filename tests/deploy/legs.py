"""A robot on legs in MuJoCo, under its controller."""

from types import SimpleNamespace

import numpy as np
from omegaconf import DictConfig

from physai.config import validate
from physai.deploy import ControllerConfig, Goal, Imu, JointState, State, make_controller
from physai.envs.simulation import EnvConfig
from physai.physics.interface import at_home
from physai.physics.rotation import rotate_back
from physai.robots import RobotSpec
from physai.targets import make
from tests.deploy.troubled import Troubled

PERIOD, SUBSTEPS = 0.02, 4
AHEAD = (0.5, 0.0, 0.0)
DEFAULT = object()


class Legs:
    """It starts at home, is heard of every period unless a test says otherwise, and does what it is told."""

    def __init__(self, policy, **config):
        env = validate(EnvConfig, DictConfig(policy.metadata.raw["config"]["env"]))
        self.spec = RobotSpec.from_config(env.robot)
        self.physics = make("physics", env.physics, self.spec, 1, PERIOD, SUBSTEPS)
        self.physics.reset(np.zeros(1, int), at_home(self.spec, 1))
        self.policy = Troubled(policy)
        self.controller = make_controller(self.policy, ControllerConfig(**config), self.policy.stopwatch)
        self.now, self.told = 100.0, self.spec.home

    @property
    def true(self):
        """Where it is, and its velocity along its own axes."""
        state = self.physics.robot_state()
        pose, twist = state.base_pose, state.base_twist
        velocity, rate = (rotate_back(pose[:, 3:], part)[0] for part in (twist[:, :3], twist[:, 3:]))
        joints = state.joint_position[0], state.joint_velocity[0]
        return SimpleNamespace(pose=pose[0], velocity=velocity, rate=rate, position=joints[0], speed=joints[1])

    def state(self, **changes):
        true = self.true
        told = {"names": self.spec.joints, "position": true.position, "velocity": true.speed, "stamp": self.now}
        return JointState(**told | changes)

    def imu(self, **changes):
        true = self.true
        told = {"orientation": true.pose[3:], "angular_velocity": true.rate, "stamp": self.now, "frame": self.spec.base}
        return Imu(**told | changes)

    def tick(self, goal=None, state=DEFAULT, imu=DEFAULT, after=PERIOD, interlocks=()):
        """Pass a period, and let the controller answer."""
        self.physics.step(self.told[None])
        self.now += after
        state, imu = self.state() if state is DEFAULT else state, self.imu() if imu is DEFAULT else imu
        goal = None if goal is None else Goal(goal, self.spec.base)
        command = self.controller.update(self.now, state, goal, interlocks, imu)
        if command.value is not None:
            self.told = command.value
        return command

    def pass_by(self, count):
        """Periods in which the controller is not asked."""
        for _ in range(count):
            self.physics.step(self.told[None])
            self.now += PERIOD

    def ticks(self, count, **arguments):
        return [self.tick(**arguments) for _ in range(count)]

    def walk(self, count=100):
        """Until it walks ahead."""
        command = self.ticks(count, goal=AHEAD)[-1]
        assert command.state is State.ACTIVE
        assert command.reasons == ()
        return command

    @property
    def counters(self):
        return self.controller.snapshot()["counters"]
