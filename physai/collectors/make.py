"""The one place where a config becomes a collector."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from physai.collectors.interface import FrameSource
from physai.collectors.multi_async import RobotMultiAsyncCollector
from physai.collectors.multi_sync import RobotMultiSyncCollector
from physai.collectors.single import RobotCollector
from physai.config import Config, Count
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError
from physai.seeding import derive


class CollectorConfig(Config):
    """One file of ``conf/collector``; ``num_envs`` and ``frames_per_batch`` are those of all processes together.

    With ``sync``, the learner waits for each batch, and a single process is its own. All others are forked from it or,
    with ``ray_init``, arguments of ``ray.init``, started by Ray.
    """

    num_envs: Count
    frames_per_batch: Count
    processes: Count
    sync: bool
    ray_init: dict[str, Any] | None

    @property
    def in_process(self) -> bool:
        """Whether the learner's process collects."""
        return self.processes == 1 and self.sync and self.ray_init is None

    @property
    def smallest(self) -> "CollectorConfig":
        """One robot in the learner's own process, for batches of the same size."""
        return self.model_copy(update={"num_envs": 1, "processes": 1, "sync": True, "ray_init": None})

    @property
    def envs_of_learner(self) -> int:
        """How many robots the learner's own process needs: all, or one that shows what others are like."""
        return self.num_envs if self.in_process else 1


def make_collector(
    config: CollectorConfig,
    env: TransformedRobotEnv,
    make_env: Callable[[int, int], TransformedRobotEnv],
    policy: TensorDictModuleBase,
    total_frames: int,
    seed: int,
    warmup_frames: int,
    device: torch.device,
) -> FrameSource:
    """Build the collector that a config describes.

    Args:
        config: How many robots, in which processes.
        env: The learner's own; a single process collects from it.
        make_env: Builds the env of a worker from a number of robots and a seed.
        policy: What acts; it may change between batches.
        total_frames: Rounded up to whole batches.
        seed: Seeds the robots and the exploration of each worker.
        warmup_frames: So many frames, rounded up to whole batches, have random actions.
        device: Where the policy is; robots and batches are on the CPU.

    Raises:
        UserError: If robots or steps cannot be shared out evenly, or if Ray does not start.
    """
    robots, frames, processes = config.num_envs, config.frames_per_batch, config.processes
    if robots % processes:
        raise UserError(f"collector.num_envs ({robots}) must be a multiple of collector.processes ({processes})")
    if frames % robots:
        raise UserError(f"collector.frames_per_batch ({frames}) must be a multiple of collector.num_envs ({robots})")
    if config.ray_init is not None and not config.sync:
        raise UserError("collector.sync must be true where there is a collector.ray_init")
    sizes: dict[str, Any] = {
        "frames_per_batch": frames,
        "total_frames": -(-total_frames // frames) * frames,
        "init_random_frames": -(-warmup_frames // frames) * frames,
    }
    if config.in_process:
        cpu = torch.device("cpu")
        # Named devices are cast to at every step; where all is on the CPU, nothing needs to be.
        devices = {} if device == cpu else {"policy_device": device, "env_device": cpu, "storing_device": cpu}
        # New batches are as fast as one that is filled again.
        return RobotCollector(env, policy, auto_register_policy_transforms=False, use_buffers=False, **sizes, **devices)

    def make_worker_env(worker: int) -> TransformedRobotEnv:
        torch.set_num_threads(1)
        torch.manual_seed(derive(seed, "exploration", worker))
        return make_env(robots // processes, derive(seed, "train", worker))

    parts = processes, make_worker_env, policy, env
    if config.ray_init is not None:
        try:
            from physai.collectors.ray import RobotRayCollector  # it takes its time, and is there only if wanted
        except ModuleNotFoundError as error:
            raise UserError(f"collector.ray_init needs {error.name}: pip install 'physai[ray]'") from error
        return RobotRayCollector(*parts, ray_init=config.ray_init, **sizes)
    return (RobotMultiSyncCollector if config.sync else RobotMultiAsyncCollector)(*parts, **sizes)
