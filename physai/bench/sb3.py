"""Stable-Baselines3: its algorithms as they come, and PPO as fast as we could make it on our robots."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor, nn

from physai.bench.learner import Array, RestartingRobots
from physai.envs.gym_env import RobotVectorEnv

SLOWEST_RATE = 0.05  # of the learning rate, when the schedule has come to its end


class RobotVecEnv(VecEnv):
    """Our vector env as Stable-Baselines3 wants it: an episode that is over restarts in the same step.

    Args:
        robots: They belong to this env, and are stepped by it alone.
        features: Whether the task's features follow the observation.
    """

    def __init__(self, robots: RobotVectorEnv, features: bool = False) -> None:
        self.robots, self.simulation = robots, robots.simulation
        self._restarting = RestartingRobots(robots, features)
        self._actions: Array = np.zeros(0)
        space = robots.single_observation_space
        assert isinstance(space, spaces.Box)
        low, high = space.low, space.high
        if features:
            room = np.full(self._restarting.reset().shape[1] - len(low), np.inf, np.float32)
            low, high = np.concatenate([low, -room]), np.concatenate([high, room])
        super().__init__(robots.num_envs, spaces.Box(low, high), robots.single_action_space)

    def reset(self) -> Array:
        """Start an episode in every row."""
        if self._seeds[0] is not None:
            self.simulation.seed(self._seeds[0])
        self._reset_seeds()
        return self._restarting.reset()

    def step_async(self, actions: Array) -> None:
        """Take note of the actions."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:
        """Apply the actions; returns observation, reward, done and info, the observation of rows that are done anew."""
        observation, last, reward, terminated, truncated = self._restarting.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{}] * self.num_envs  # rows that go on have nothing to say, and share it
        for row in done.nonzero()[0]:
            infos[row] = {"terminal_observation": last[row], "TimeLimit.truncated": bool(truncated[row])}
        return observation, reward, done, infos

    def close(self) -> None:
        """Free the simulation."""
        self._restarting.close()

    # The robots of a row are no objects of their own.

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the vector env, for each row."""
        return [getattr(self.robots, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse."""
        raise NotImplementedError

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Refuse."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None) -> list[bool]:
        """Whether rows are wrapped: they are not."""
        return [False] * len(list(self._get_indices(indices)))


@dataclass(frozen=True)
class Settings:
    """Which env, which algorithm, and what it takes.

    Attributes:
        make_envs: Makes the env.
        arguments: The algorithm's; its ``learning_rate`` among them.
        algorithm: Its class.
        frames: Learned at a time; an on-policy algorithm rounds up to a batch.
        features: Whether the policy is told the task's features, too, as physai's is; this is more than a setting.
        horizon: Frames until the learning rate has fallen to its end; 0 leaves it as it is.
        trial: Arguments for the choice of threads, where a batch takes long.
    """

    make_envs: Callable[[], VecEnv]
    arguments: dict[str, Any]
    algorithm: type[BaseAlgorithm] = PPO
    frames: int = 1
    features: bool = False
    horizon: int = 0
    trial: dict[str, Any] = field(default_factory=dict)

    def learner(self, seed: int, threads: int = 1, **changed: Any) -> "Learner":
        """Make the learner."""
        return Learner(self, seed, threads, **changed)


def _our_envs(num_envs: int, features: bool) -> VecEnv:
    return VecNormalize(RobotVecEnv(RobotVectorEnv("reacher", num_envs), features), norm_reward=False)


DEFAULTS = Settings(
    partial(make_vec_env, "physai/Reacher-v0", 4),  # a DummyVecEnv
    # The numbers that users know; all but ent_coef are also PPO's defaults.
    {
        "learning_rate": 3e-4,
        "n_steps": 2048,
        "batch_size": 64,
        "n_epochs": 10,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "clip_range": 0.2,
        "ent_coef": 0.005,
        "vf_coef": 0.5,
        "max_grad_norm": 0.5,
    },
    trial={"n_steps": 256},
)
# Found by many runs over robots, steps, minibatches, epochs, learning rates, discounts, networks and their
# activation: what fewer frames need in more gradient steps costs more time than it saves.
_TUNED: dict[str, Any] = {
    "learning_rate": 2e-3,
    "n_steps": 16,
    "batch_size": 1024,
    "n_epochs": 5,
    "gamma": 0.95,
    "gae_lambda": 0.95,
    "policy_kwargs": {
        "net_arch": [64, 64],  # of actor and critic each
        "activation_fn": nn.ReLU,
        "optimizer_kwargs": {"eps": 1e-5, "fused": True},
    },
}
TUNED = Settings(partial(_our_envs, 256, features=False), _TUNED, horizon=1_000_000)
TUNED_WITH_FEATURES = Settings(partial(_our_envs, 256, features=True), _TUNED, features=True, horizon=200_000)


def as_it_comes(algorithm: str) -> Settings:
    """The settings that an algorithm has by itself, on as many envs as its documentation's examples have."""
    if algorithm == "ppo":
        return DEFAULTS
    kinds: dict[str, tuple[type[BaseAlgorithm], float, int]] = {  # their default learning rates
        "a2c": (A2C, 7e-4, 4),
        "sac": (SAC, 3e-4, 1),
        "td3": (TD3, 1e-3, 1),
        "ddpg": (DDPG, 1e-3, 1),
    }
    kind, rate, envs = kinds[algorithm]
    return Settings(partial(make_vec_env, "physai/Reacher-v0", envs), {"learning_rate": rate}, kind, frames=1024)


def _with_goals(observation: Array, space: spaces.Dict) -> dict[str, Array]:
    """What a goal env shows, from what its task observes, [N, o]: that ends with where the robot is, and the goal."""
    (size,) = space["desired_goal"].shape or ()
    own = observation[:, :-size]
    return {"observation": own, "achieved_goal": own[:, -size:], "desired_goal": observation[:, -size:]}


class Learner:
    """An algorithm, some frames at a time.

    Args:
        settings: What it is like.
        seed: Of weights, exploration, minibatches and goals.
        threads: Of torch.
        changed: Arguments that differ.
    """

    def __init__(self, settings: Settings, seed: int, threads: int = 1, **changed: Any) -> None:
        self.in_keys = ["observation", "features"] if settings.features else ["observation"]
        self._envs = settings.make_envs()
        self._horizon, self._threads, self._frames, self._at_a_time = settings.horizon, threads, 0, settings.frames
        arguments = settings.arguments | changed
        self._rate = arguments["learning_rate"]
        # Torch would check the arguments of every distribution, at every step.
        torch.distributions.Distribution.set_default_validate_args(False)
        arguments["learning_rate"] = self._learning_rate
        policy = "MultiInputPolicy" if isinstance(self._envs.observation_space, spaces.Dict) else "MlpPolicy"
        self.model = settings.algorithm(policy, self._envs, seed=seed, device="cpu", **arguments)
        self.model.set_logger(Logger(None, []))

    def _learning_rate(self, _: float) -> float:
        # What it says of its progress refers to one call of learn(), of which there are many here.
        left = 1.0 - self._frames / self._horizon if self._horizon else 1.0
        return float(self._rate * max(SLOWEST_RATE, left))

    def learn(self) -> int:
        """Collect and learn; returns the frames."""
        torch.set_num_threads(self._threads)
        before = self._frames
        self.model.learn(self._at_a_time, reset_num_timesteps=False)
        self._frames = self.model.num_timesteps
        return self._frames - before

    def act(self, *seen: Tensor) -> Tensor:
        """Return the actions of the policy's mode [N, n], told what ``in_keys`` name."""
        told, space = torch.cat(seen, dim=1).numpy(), self._envs.observation_space
        return torch.from_numpy(self.predict(_with_goals(told, space) if isinstance(space, spaces.Dict) else told))

    def predict(self, told: Any) -> Array:
        """Return the actions of the policy's mode, told what its envs show."""
        if isinstance(self._envs, VecNormalize):
            told = self._envs.normalize_obs(told)
        return self.model.predict(told, deterministic=True)[0]

    def close(self) -> None:
        """Free the robots."""
        self._envs.close()
