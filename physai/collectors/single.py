"""One process, many robots."""

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector


class RobotCollector(Collector):
    """TorchRL's collector, with a state that continues bit for bit.

    Batches are [N, T]. The first observation of a batch was made at the end of the last one: it is normalized again,
    so that one set of statistics holds for the whole batch.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs, track_traj_ids=False)
        self._draw_action = self.env.rand_action
        self.env.rand_action = self._act_at_random

    def _act_at_random(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Draw the actions of ``init_random_frames``.

        The policy acts, too, and is not obeyed: what it remembers goes on, and all batches have the same keys.
        """
        seen = tensordict if self.policy_device is None else tensordict.to(self.policy_device)
        output = self._wrapped_policy(seen).select(*self._policy_output_keys)
        return self._draw_action(tensordict.update(output.to(self.env_device) if self.policy_device else output))

    def rollout(self) -> TensorDictBase:
        """Collect one batch."""
        self._carrier.set("normalized_observation", self.env.normalizer(self._carrier.get("observation")))
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
