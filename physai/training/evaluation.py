"""Judging a policy: one deterministic episode per goal, all goals at once."""

from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.envs.make import TransformedRobotEnv

MAX_ROBOTS = 1000


@dataclass(frozen=True)
class Evaluation:
    """Results of E episodes, each [E].

    Attributes:
        success: Whether the last step of the episode was a success.
        length: Control steps until the first success of an episode that ended with one, or until its end.
        error: The task's largest error at the end, of those in the unit of its first one.
        episode_return: Sum of rewards.
        unit: Of the error.
    """

    success: Tensor
    length: Tensor
    error: Tensor
    episode_return: Tensor
    unit: str

    @property
    def success_rate(self) -> float:
        """Share of goals reached."""
        return float(self.success.double().mean())

    @property
    def success_ci(self) -> tuple[float, float]:
        """95 % confidence interval of the success rate (Wilson, 1927)."""
        from scipy.stats import binomtest  # takes half a second to import: nobody waits for it before the first frame

        interval = binomtest(int(self.success.sum()), len(self.success)).proportion_ci(method="wilson")
        return float(interval.low), float(interval.high)

    def summary(self) -> dict[str, float | list[float] | str | None]:
        """The figures that scripts rely on.

        ``steps_to_goal`` averages over reached goals, and is None without any; ``final_distance`` is the mean error.
        """
        reached = self.length[self.success]
        return {
            "success_rate": self.success_rate,
            "success_ci": list(self.success_ci),
            "steps_to_goal": float(reached.double().mean()) if len(reached) else None,
            "final_distance": float(self.error.double().mean()),
            "distance_unit": self.unit,
            "return": float(self.episode_return.double().mean()),
        }


def evaluate(policy: TensorDictModuleBase, env: TransformedRobotEnv, episodes: int, seed: int) -> Evaluation:
    """Let a policy act deterministically for one episode per goal; the goals follow from the seed alone.

    Args:
        policy: Writes ``action``.
        env: Its robots each play one episode at a time; its normalization is used as it is.
        episodes: How many goals.
        seed: Seeds goals, starts, and whatever the env randomizes.
    """
    env.set_seed(seed)
    rounds = [_one_round(policy, env) for _ in range(-(-episodes // env.simulation.num_envs))]
    columns = (torch.cat(column)[:episodes] for column in zip(*rounds, strict=True))
    success, length, error, episode_return = columns
    return Evaluation(success, length, error, episode_return, env.simulation.task.tolerances[0].unit)


@torch.no_grad()
def _one_round(policy: TensorDictModuleBase, env: TransformedRobotEnv) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    tensordict = env.reset()
    tolerances = env.simulation.task.tolerances
    columns = [i for i, tolerance in enumerate(tolerances) if tolerance.unit == tolerances[0].unit]
    robots = env.simulation.num_envs
    finished, success = torch.zeros(2, robots, dtype=torch.bool)
    length, first = torch.zeros(2, robots, dtype=torch.int64)
    error, episode_return = torch.zeros(2, robots)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while not finished.all():
            tensordict = env.step(policy(tensordict)).get("next")
            succeeds, steps = tensordict.get("success")[:, 0], tensordict.get("episode_length")[:, 0]
            first = torch.where(succeeds & (first == 0), steps, first)
            # Robots that are done idle on until the last one is; only their first episode counts.
            now = tensordict.get("done")[:, 0] & ~finished
            finished |= now
            success[now] = succeeds[now]
            length[now] = torch.where(succeeds, first, steps)[now]
            error[now] = torch.from_numpy(env.simulation.error[:, columns].max(axis=1)).float()[now]
            episode_return[now] = tensordict.get("episode_rewards").sum(dim=1)[now]
    return success, length, error, episode_return
