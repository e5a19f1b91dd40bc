"""The one place where a config becomes a collector."""

from collections.abc import Callable

import torch
from tensordict.nn import TensorDictModuleBase

from physai.collectors.multi_sync import RobotMultiCollector
from physai.collectors.single import RobotCollector
from physai.config import Config, Count
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError
from physai.seeding import derive


class CollectorConfig(Config):
    """One file of ``conf/collector``; ``num_envs`` and ``frames_per_batch`` are those of all processes together."""

    num_envs: Count
    frames_per_batch: Count
    processes: Count

    @property
    def robots_here(self) -> int:
        """How many robots the learner's own process needs: all, or one that shows what others are like."""
        return self.num_envs if self.processes == 1 else 1


def make_collector(
    config: CollectorConfig,
    env: TransformedRobotEnv,
    make_env: Callable[[int, int], TransformedRobotEnv],
    policy: TensorDictModuleBase,
    total_frames: int,
    seed: int,
) -> RobotCollector | RobotMultiCollector:
    """Build the collector that a config describes.

    Args:
        config: How many robots, in how many processes.
        env: The learner's own; a single process collects from it.
        make_env: Builds the env of a worker from a number of robots and a seed.
        policy: What acts.
        total_frames: Rounded up to whole batches.
        seed: Seeds the robots and the exploration of each worker.

    Raises:
        UserError: If robots or steps cannot be shared out evenly.
    """
    robots, frames, processes = config.num_envs, config.frames_per_batch, config.processes
    if robots % processes:
        raise UserError(f"collector.num_envs ({robots}) must be a multiple of collector.processes ({processes})")
    if frames % robots:
        raise UserError(f"collector.frames_per_batch ({frames}) must be a multiple of collector.num_envs ({robots})")
    total_frames = -(-total_frames // frames) * frames
    if processes == 1:
        return RobotCollector(
            env,
            policy,
            frames_per_batch=frames,
            total_frames=total_frames,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )

    def make_worker_env(worker: int) -> TransformedRobotEnv:
        torch.manual_seed(derive(seed, "exploration", worker))
        return make_env(robots // processes, derive(seed, "train", worker))

    return RobotMultiCollector(processes, make_worker_env, policy, env.normalization.normalizer, frames, total_frames)
