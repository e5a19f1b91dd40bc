"""What a recurrent policy remembers, carried from step to step."""

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform


class Memory(Transform):
    """Hands the policy as ``memory`` what it wrote as ``new_memory`` a step before; zeros where an episode begins.

    (TorchRL's recurrent modules write ``("next", key)`` themselves, with a primer that resets it; our envs make
    ``next`` anew at each step.)

    Args:
        size: H.
        num_envs: N.
    """

    def __init__(self, size: int, num_envs: int) -> None:
        super().__init__(in_keys=["new_memory"], out_keys=["memory"])
        self._shape = num_envs, size

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        memory = tensordict.get("new_memory", None)
        if memory is None:  # nobody has acted who remembers
            memory = tensordict.get("memory", None)
        return next_tensordict.set("memory", torch.zeros(self._shape) if memory is None else memory)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set("memory", torch.zeros(self._shape))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the key that the transform writes."""
        observation_spec["memory"] = Unbounded(shape=self._shape)
        return observation_spec
