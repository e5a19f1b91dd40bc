"""One process, many robots."""

from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from physai.config import Config, Count
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError


class CollectorConfig(Config):
    """One file of ``conf/collector``."""

    num_envs: Count
    frames_per_batch: Count


class RobotCollector(Collector):
    """TorchRL's collector, with a state that continues bit for bit.

    Batches are [N, T]. The first observation of a batch was made at the end of the last one: it is normalized again,
    so that one set of statistics holds for the whole batch.
    """

    def rollout(self) -> TensorDictBase:
        """Collect one batch."""
        self._carrier.set("normalized_observation", self.env.normalization.normalizer(self._carrier.get("observation")))
        return super().rollout()

    def state(self) -> dict[str, Any]:
        """Return the state of the env and what is carried from one batch to the next."""
        return {
            "env": self.env.state(),
            "carrier": self._carrier.to_dict(retain_none=False),
            "frames": self._frames,
            "iterations": self._iter,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned, in a collector made from the same config."""
        self.env.set_state(state["env"])
        self._carrier = TensorDict(state["carrier"], batch_size=self.env.batch_size)
        self._frames, self._iter = state["frames"], state["iterations"]


def make_collector(
    config: CollectorConfig, env: TransformedRobotEnv, policy: TensorDictModuleBase, total_frames: int
) -> RobotCollector:
    """Build the collector that a config describes.

    Raises:
        UserError: If a batch is not a whole number of steps of all robots.
    """
    if config.frames_per_batch % config.num_envs:
        raise UserError(
            f"collector.frames_per_batch ({config.frames_per_batch}) must be a multiple of "
            f"collector.num_envs ({config.num_envs})"
        )
    return RobotCollector(
        env,
        policy,
        frames_per_batch=config.frames_per_batch,
        total_frames=-(-total_frames // config.frames_per_batch) * config.frames_per_batch,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
