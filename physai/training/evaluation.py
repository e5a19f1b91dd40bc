"""Judging a policy: deterministic episodes, all goals at once; and goals one after the other."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.envs.make import TransformedRobotEnv

MAX_ROBOTS = 1000
WATCHED = 8  # robots whose episodes are recorded, if somebody watches
ROBOTS_IN_A_ROW = 64
SETTLED = 0.5  # s, at the end of an episode's time
NEAR_LIMIT = 0.05  # rad


def wilson(success: Tensor) -> tuple[float, float]:
    """Return the 95 % confidence interval of a rate (Wilson, 1927).

    Args:
        success: Of independent episodes [E], or of E robots that had G episodes each, one after the other, [E, G].
            Those of one robot depend on each other: then their number counts for less, by the design effect (Kish,
            1965).
    """
    from scipy.stats import binomtest  # takes half a second to import: nobody waits for it before the first frame

    successes, episodes = int(success.sum()), success.numel()
    if success.ndim > 1 and len(success) > 1 and 0 < successes < episodes:
        rate, of_robots = successes / episodes, success.double().mean(dim=1)
        effect = max(1.0, success.shape[1] * float(of_robots.var()) / (rate * (1.0 - rate)))
        successes, episodes = round(successes / effect), round(episodes / effect)
    interval = binomtest(successes, episodes).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


@dataclass(frozen=True)
class Evaluation:
    """Results of E episodes, each [E]; and how they moved, in T steps each of n joints, [E, T·n].

    Attributes:
        success: Whether the last step of the episode was a success.
        settled: Whether all errors were within their tolerances in the last ``SETTLED`` s of its time, in which the
            robot was watched on after a success.
        crashed: Whether the episode, or the time after its success, was ended by a failure, such as a collision.
        length: Control steps until the first success of an episode that ended with one, or until its end.
        error: The task's largest error at the end, of those in the unit of its first one.
        episode_return: Sum of rewards.
        action_change: By how much the action changed from step to step; 1 is a joint's largest command.
        acceleration: Mean of each control period, rad/s².
        unit: Of the error.
        mean_error: Each of the task's errors by name, its mean over all of the episodes, and its unit; none where a
            goal lasts an episode, whose end says more.
    """

    success: Tensor
    settled: Tensor
    crashed: Tensor
    length: Tensor
    error: Tensor
    episode_return: Tensor
    action_change: Tensor
    acceleration: Tensor
    unit: str
    mean_error: Mapping[str, tuple[float, str]] = field(default_factory=dict)

    @property
    def success_rate(self) -> float:
        """Share of goals reached."""
        return float(self.success.double().mean())

    @property
    def success_ci(self) -> tuple[float, float]:
        """95 % confidence interval of the success rate."""
        return wilson(self.success)

    @property
    def settled_rate(self) -> float:
        """Share of goals that the robots stayed at."""
        return float(self.settled.double().mean())

    @property
    def settled_ci(self) -> tuple[float, float]:
        """95 % confidence interval of the settled rate."""
        return wilson(self.settled)

    def summary(self) -> dict[str, Any]:
        """The figures that scripts rely on.

        ``steps_to_goal`` averages over reached goals, and is None without any; ``final_distance`` is the mean error.
        Where goals change in an episode, ``mean_error`` has value and unit of each error.
        """
        reached = self.length[self.success]
        return {
            "success_rate": self.success_rate,
            "success_ci": list(self.success_ci),
            "settled_rate": self.settled_rate,
            "settled_ci": list(self.settled_ci),
            "crashed_rate": float(self.crashed.double().mean()),
            "crashed_ci": list(wilson(self.crashed)),
            "steps_to_goal": float(reached.double().mean()) if len(reached) else None,
            "final_distance": float(self.error.double().mean()),
            "distance_unit": self.unit,
            "return": float(self.episode_return.double().mean()),
            **_mean_and_p99("action_change", self.action_change),
            **_mean_and_p99("acceleration", self.acceleration),
            **({"mean_error": {name: list(told) for name, told in self.mean_error.items()}} if self.mean_error else {}),
        }


@dataclass(frozen=True)
class Recording:
    """The episodes of K robots in an evaluation, T steps each; what came after a success is in it, too.

    Attributes:
        joint_position: rad, [T, K, n].
        goal: [K, g].
        success: Whether the episodes were one, [K].
        base_pose: Of a base that floats: x, y, z, m, and a quaternion x, y, z, w, [T, K, 7]; None of a fixed one.
    """

    joint_position: np.ndarray
    goal: np.ndarray
    success: np.ndarray
    base_pose: np.ndarray | None = None


def _mean_and_p99(name: str, values: Tensor) -> dict[str, float]:
    array = values.double().numpy()
    return {f"{name}_mean": float(array.mean()), f"{name}_p99": float(np.quantile(array, 0.99))}


def evaluate(
    policy: TensorDictModuleBase,
    env: TransformedRobotEnv,
    episodes: int,
    seed: int,
    watch: Callable[[Recording], object] | None = None,
) -> Evaluation:
    """Let a policy act deterministically for one episode per goal; the goals follow from the seed alone.

    After a success a robot goes on towards the same goal for the rest of the episode's time: nothing else shows
    whether it stays there.

    Args:
        policy: Writes ``action``.
        env: Its robots each play one episode at a time; its normalization is used as it is.
        episodes: How many goals.
        seed: Seeds goals, starts, and whatever the env randomizes.
        watch: Gets the first episodes of the first robots.
    """
    env.set_seed(seed)
    robots = env.simulation.num_envs
    rounds = [_one_round(policy, env, None if first else watch) for first in range(0, episodes, robots)]
    columns = {key: torch.cat([each[key] for each in rounds])[:episodes] for key in rounds[0]}
    task, means = env.simulation.task, columns.pop("mean_error").double().mean(dim=0).tolist()
    told = {each.name: (mean, each.unit) for each, mean in zip(task.tolerances, means, strict=True)}
    return Evaluation(**columns, unit=task.tolerances[0].unit, mean_error=told if task.goal_steps else {})


@torch.no_grad()
def _one_round(
    policy: TensorDictModuleBase, env: TransformedRobotEnv, watch: Callable[[Recording], object] | None
) -> dict[str, Tensor]:
    """Return the columns of an Evaluation, and the means of all errors, [E, e]."""
    simulation, tensordict = env.simulation, env.reset()
    task, dt, robots = simulation.task, simulation.config.control_dt, simulation.num_envs
    columns = [i for i, tolerance in enumerate(task.tolerances) if tolerance.unit == task.tolerances[0].unit]
    finished, success, crashed = torch.zeros(3, robots, dtype=torch.bool)
    length, first = torch.zeros(2, robots, dtype=torch.int64)
    error, episode_return = torch.zeros(2, robots)
    mean_error = torch.zeros(robots, len(task.tolerances))
    changes, accelerations, path = [], [], []
    poses: list[np.ndarray] = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(task.max_steps):
            action, velocity = simulation.last_action, simulation.state.joint_velocity
            tensordict = env.step(policy(tensordict)).get("next")
            changes.append(np.abs(simulation.last_action - action))
            accelerations.append(np.abs(simulation.state.joint_velocity - velocity) / dt)
            if watch is not None:
                path.append(simulation.state.joint_position[:WATCHED])
                if simulation.state.base_pose is not None:
                    poses.append(simulation.state.base_pose[:WATCHED])
            succeeds, steps = tensordict.get("success")[:, 0], tensordict.get("episode_length")[:, 0]
            first = torch.where(succeeds & (first == 0), steps, first)
            crashed |= tensordict.get("terminated")[:, 0] & ~succeeds
            now = tensordict.get("done")[:, 0] & ~finished
            finished |= now
            success[now] = succeeds[now]
            length[now] = torch.where(succeeds, first, steps)[now]
            error[now] = torch.from_numpy(simulation.error[:, columns].max(axis=1)).float()[now]
            mean_error[now] = torch.from_numpy(simulation.error_sum / steps.numpy().clip(1)[:, None]).float()[now]
            episode_return[now] = tensordict.get("episode_rewards").sum(dim=1)[now]
    if watch is not None:
        pose = np.stack(poses) if poses else None
        watch(Recording(np.stack(path), simulation.goal[:WATCHED], success[:WATCHED].numpy(), pose))
    stayed = simulation.within >= min(math.ceil(SETTLED / dt - 1e-9), task.max_steps)
    return {
        "success": success,
        "settled": torch.from_numpy(stayed) & ~crashed,
        "crashed": crashed,
        "length": length,
        "error": error,
        "mean_error": mean_error,
        "episode_return": episode_return,
        "action_change": torch.from_numpy(np.concatenate(changes, axis=1)).float(),
        "acceleration": torch.from_numpy(np.concatenate(accelerations, axis=1)).float(),
    }


@torch.no_grad()
def evaluate_in_a_row(
    policy: TensorDictModuleBase, env: TransformedRobotEnv, goals: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Give each robot goals one after the other, and never bring it home in between.

    What one episode hides shows here: an arm that turns into its joint limits, goal by goal.

    Args:
        policy: Writes ``action``.
        env: E robots whose episodes begin where their last ones ended (``start.carried_over=1``).
        goals: How many each robot gets, G.
        seed: Seeds goals, starts, and whatever the env randomizes.

    Returns:
        Whether the robots succeeded, [E, G]; and the share of time that each joint was within ``NEAR_LIMIT`` of one of
        its limits, [n].
    """
    env.set_seed(seed)
    low, high = env.simulation.spec.position_limit.T
    near, steps = np.zeros(len(low)), 0
    tensordict, robots = env.reset(), env.simulation.num_envs
    success, played = torch.zeros(robots, goals, dtype=torch.bool), torch.zeros(robots, dtype=torch.int64)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while (played < goals).any():
            after, tensordict = env.step_and_maybe_reset(policy(tensordict))
            after = after.get("next")
            position, going_on = env.simulation.state.joint_position, (played < goals).numpy()
            at_limit = (position < low + NEAR_LIMIT) | (position > high - NEAR_LIMIT)
            near, steps = near + at_limit[going_on].sum(axis=0), steps + int(going_on.sum())
            ended = (after.get("done")[:, 0] & (played < goals)).nonzero()[:, 0]
            success[ended, played[ended]] = after.get("success")[ended, 0]
            played[ended] += 1
    return success, torch.from_numpy(near / steps)
