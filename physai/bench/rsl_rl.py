"""rsl_rl: its PPO as Isaac Lab sets it for an arm that reaches, and as fast as we could make it on our robots."""

import contextlib
import io
from dataclasses import dataclass, field
from typing import Any

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict
from torch import Tensor

from physai.bench.learner import RestartingRobots
from physai.envs.gym_env import RobotVectorEnv


class RobotVecEnv(VecEnv):
    """Our vector env as rsl_rl wants it: an episode that is over restarts in the same step.

    Args:
        robots: They belong to this env, and are stepped by it alone.
        features: Whether the task's features follow the observation.
    """

    def __init__(self, robots: RobotVectorEnv, features: bool = False) -> None:
        self._robots = RestartingRobots(robots, features)
        self.num_envs, self.num_actions = robots.num_envs, len(robots.simulation.spec.joints)
        self.max_episode_length = robots.simulation.task.max_steps
        self.device = "cpu"
        self.cfg: dict[str, Any] = {}

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps of each robot's episode so far, [N]."""
        return torch.from_numpy(self._robots.simulation.episode_length[:, 0])

    def seed(self, seed: int) -> None:
        """Begin anew, with random numbers from this seed."""
        self._robots.simulation.seed(seed)
        self._robots.reset()

    def get_observations(self) -> TensorDict:
        """Return what is observed now."""
        return TensorDict({"policy": torch.from_numpy(self._robots.observe()).float()}, [self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Tensor]]:
        """Apply the actions; returns observation, reward, done and which episodes ran out of time."""
        told = actions.clamp(-1.0, 1.0).numpy()  # its policy knows no limits
        observation, _, reward, terminated, truncated = self._robots.step(told)
        seen = TensorDict({"policy": torch.from_numpy(observation).float()}, [self.num_envs])
        return (
            seen,
            torch.from_numpy(reward),
            torch.from_numpy(terminated | truncated),
            {"time_outs": torch.from_numpy(truncated & ~terminated)},
        )

    def close(self) -> None:
        """Free the simulation."""
        self._robots.close()


@dataclass(frozen=True)
class Settings:
    """Robots, and what a runner takes.

    Attributes:
        robots: How many.
        steps: Of each robot in a batch.
        algorithm: Arguments of its PPO.
        activation: Of both networks, which have two layers of 64.
        normalized: Whether networks see normalized observations.
        features: Whether the policy is told the task's features, too, as physai's is; this is more than a setting.
        horizon: Frames until the learning rate has fallen to its end; 0 leaves it to rsl_rl.
        trial: Arguments for the choice of threads.
    """

    robots: int
    steps: int
    algorithm: dict[str, Any]
    activation: str = "elu"
    normalized: bool = False
    features: bool = False
    horizon: int = 0
    trial: dict[str, Any] = field(default_factory=dict)

    def learner(self, seed: int, threads: int = 1, **changed: Any) -> "Learner":
        """Make the learner."""
        return Learner(self, seed, threads, **changed)

    def runner(self) -> dict[str, Any]:
        """What a runner takes."""
        network = {
            "class_name": "MLPModel",
            "hidden_dims": [64, 64],
            "activation": self.activation,
            "obs_normalization": self.normalized,
        }
        return {
            "num_steps_per_env": self.steps,
            "save_interval": 1_000_000,
            "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
            "algorithm": {"class_name": "PPO"} | self.algorithm,
            "actor": network | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}},
            "critic": network,
        }


# Isaac Lab's UR10ReachPPORunnerCfg.
_ISAAC_LAB: dict[str, Any] = {
    "value_loss_coef": 1.0,
    "use_clipped_value_loss": True,
    "clip_param": 0.2,
    "entropy_coef": 0.01,
    "num_learning_epochs": 8,
    "num_mini_batches": 4,
    "learning_rate": 1e-3,
    "schedule": "adaptive",
    "gamma": 0.99,
    "lam": 0.95,
    "desired_kl": 0.01,
    "max_grad_norm": 1.0,
}
# Found by some thirty runs over robots, steps, epochs, minibatches, schedules, rates and activations.
_TUNED = _ISAAC_LAB | {"entropy_coef": 0.0, "gamma": 0.95}
_FAST = {
    "num_learning_epochs": 3,
    "schedule": "fixed",
    "learning_rate": 4e-3,
    "use_clipped_value_loss": False,
}
ISAAC_LAB = Settings(512, 24, _ISAAC_LAB)
TUNED = Settings(512, 8, _TUNED | {"num_learning_epochs": 5, "desired_kl": 0.02}, "relu", normalized=True)
TUNED_WITH_FEATURES = Settings(512, 4, _TUNED | _FAST, "relu", normalized=True, features=True)


class Learner:
    """A runner, one batch at a time.

    Args:
        settings: What it is like.
        seed: Of weights, exploration, minibatches and goals.
        threads: Of torch.
        changed: Arguments of the algorithm that differ.
    """

    def __init__(self, settings: Settings, seed: int, threads: int = 1, **changed: Any) -> None:
        self.in_keys = ["observation", "features"] if settings.features else ["observation"]
        self._threads, self._frames = threads, settings.robots * settings.steps
        torch.manual_seed(seed)
        # Torch would check the arguments of every distribution, at every step.
        torch.distributions.Distribution.set_default_validate_args(False)
        self._envs = RobotVecEnv(RobotVectorEnv("reacher", settings.robots), settings.features)
        self._envs.seed(seed)
        told = settings.runner()
        told["algorithm"] |= changed
        with contextlib.redirect_stdout(io.StringIO()):  # it describes its networks
            self.runner = OnPolicyRunner(self._envs, told)

    def learn(self) -> int:
        """Collect and learn; returns the frames."""
        torch.set_num_threads(self._threads)
        self.runner.learn(1)
        return self._frames

    def act(self, *seen: Tensor) -> Tensor:
        """Return the actions of the policy's mode [N, n], told what ``in_keys`` name."""
        with torch.inference_mode():
            observed = TensorDict({"policy": torch.cat(seen, dim=1)}, [len(seen[0])])
            return self.runner.alg.actor(observed).clamp(-1.0, 1.0)

    def close(self) -> None:
        """Free the robots."""
        self._envs.close()
