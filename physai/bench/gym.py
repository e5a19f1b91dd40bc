"""How fast the Gymnasium envs step, against an env written by hand and against Stable-Baselines3's DummyVecEnv."""

import math
from argparse import Namespace
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pybullet as bullet
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from rich.table import Table

from physai.bench.timing import median_speeds, reacher, table
from physai.config import of_each
from physai.envs.simulation import EnvConfig
from physai.robots import RobotSpec

NAME = "physai/Reacher-v0"
ROBOTS = 64
ROUNDS = 15
STEPS = 4_000  # of one env in a round; many episodes, so that every round pays for its resets
STEPS_OF_ALL = 200  # of all robots of a vector env in a round

Array = NDArray[Any]


class HandWrittenReacher(gymnasium.Env[Array, Array]):
    """The reacher as one would write it without physai, with nothing to choose and nothing to spare.

    Args:
        config: What it has to be like.
    """

    def __init__(self, config: EnvConfig) -> None:
        spec = RobotSpec.from_config(config.robot)
        self.client = bullet.connect(bullet.DIRECT)
        bullet.setTimeStep(config.control_dt, self.client)
        bullet.setGravity(0, 0, -9.81, self.client)
        self.arm = bullet.loadURDF(str(spec.urdf), useFixedBase=True, physicsClientId=self.client)
        count = bullet.getNumJoints(self.arm, self.client)
        infos = [bullet.getJointInfo(self.arm, joint, self.client) for joint in range(count)]
        index = {name.decode(): info[0] for info in infos for name in (info[1], info[12])}  # of joints and of links
        self.joints, self.tip = [index[name] for name in spec.joints], index[spec.end_effector]
        self.efforts = spec.effort_limit.tolist()
        self.limits, self.max_steps = spec.command_limit.tolist(), config.task["max_steps"]
        self.tolerance, self.success_reward = config.task["tolerance"], config.task["success_reward"]
        self.radius = config.task["goal_radius"]
        self.spread = of_each(config.start.spread, len(spec.joints), "env.start.spread")
        self.observation_space = spaces.Box(-np.inf, np.inf, (8,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        for joint, spread in zip(self.joints, self.spread, strict=True):
            bullet.resetJointState(self.arm, joint, self.np_random.uniform(-spread, spread), 0.0, self.client)
        radius, angle = self.np_random.uniform(*self.radius), self.np_random.uniform(0, 2 * math.pi)
        self.goal_x, self.goal_y = radius * math.cos(angle), radius * math.sin(angle)
        self.steps = 0
        return self._observe()[0], {"is_success": False}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Apply an action [2] in [-1, 1] for one control period."""
        for joint, share, limit, effort in zip(self.joints, action.tolist(), self.limits, self.efforts, strict=True):
            velocity = share * limit
            bullet.setJointMotorControl2(
                self.arm, joint, bullet.VELOCITY_CONTROL, 0.0, velocity, effort, 0.1, 1.0, 0.0, self.client
            )
        bullet.stepSimulation(self.client)
        observation, distance = self._observe()
        success = distance < self.tolerance
        self.steps += 1
        truncated = self.steps >= self.max_steps and not success
        return observation, self.success_reward * success - distance, success, truncated, {"is_success": success}

    def _observe(self) -> tuple[Array, float]:
        (q1, v1, *_), (q2, v2, *_) = bullet.getJointStates(self.arm, self.joints, self.client)
        x, y, _ = bullet.getLinkState(self.arm, self.tip, 0, 0, self.client)[4]
        observation = np.array((q1, q2, v1, v2, x, y, self.goal_x, self.goal_y), np.float32)
        return observation, math.hypot(x - self.goal_x, y - self.goal_y)

    def close(self) -> None:
        """Free the world."""
        bullet.disconnect(self.client)


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return gym_table(*measure_gym(options.seed))


def measure_gym(seed: int) -> tuple[list[float], list[float]]:
    """Return robot-steps/s of the yardstick and of physai, with one robot and with many."""
    from stable_baselines3.common.vec_env import DummyVecEnv  # an extra

    config = reacher(seed)
    torch.set_num_threads(config.threads)
    random = np.random.default_rng(seed)
    actions = random.uniform(-1, 1, (STEPS, 2)).astype(np.float32)
    by_hand, one = HandWrittenReacher(config.env), gymnasium.make(NAME)
    sides = [_played(env, actions, seed) for env in (by_hand, one)]
    single = median_speeds(*sides, rounds=ROUNDS)
    by_hand.close()
    one.close()
    actions = random.uniform(-1, 1, (STEPS_OF_ALL, ROBOTS, 2)).astype(np.float32)
    dummy = DummyVecEnv([lambda: gymnasium.make(NAME)] * ROBOTS)
    vector = gymnasium.make_vec(NAME, ROBOTS, vectorization_mode="vector_entry_point")
    dummy.seed(seed)
    dummy.reset()
    vector.reset(seed=seed)
    many = median_speeds(*(_played_by_all(env, actions) for env in (dummy, vector)), rounds=ROUNDS)
    dummy.close()
    vector.close()
    return single, many


def _played(env: gymnasium.Env[Array, Array], actions: Array, seed: int) -> Callable[[], int]:
    env.reset(seed=seed)

    def play() -> int:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return len(actions)

    return play


def _played_by_all(env: Any, actions: Array) -> Callable[[], int]:
    def play() -> int:
        for action in actions:
            env.step(action)  # both restart what is over
        return STEPS_OF_ALL * ROBOTS

    return play


def gym_table(single: list[float], many: list[float]) -> Table:
    """Show robot-steps per second, and what physai makes of each yardstick."""
    shown = table(
        "Gymnasium, robot-steps/s: random actions, resets included", "", "yardstick", "steps/s", "physai", "ratio"
    )
    rows = {
        "one robot": ("PyBullet by hand", single),
        f"{ROBOTS} robots": ("DummyVecEnv of physai's", many),
    }
    for robots, (yardstick, (theirs, ours)) in rows.items():
        shown.add_row(robots, yardstick, f"{theirs:,.0f}", f"{ours:,.0f}", f"{ours / theirs:.2f}")
    return shown
