"""One process, many robots."""

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector


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
        self._frames, self._iter = int(state["frames"]), int(state["iterations"])
