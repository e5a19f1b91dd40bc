"""The policy's view: sensed joints and goal become the task's observation."""

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform


class Observation(Transform):
    """Writes ``observation`` [N, observation_size] from ``joint_position``, ``joint_velocity`` and ``goal``.

    Args:
        module: The task's observation module, the same that the exported policy carries.
        size: Length of an observation.
    """

    def __init__(self, module: nn.Module, size: int) -> None:
        super().__init__(in_keys=["joint_position", "joint_velocity", "goal"], out_keys=["observation"])
        self.module = module
        self.size = size

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        inputs = [next_tensordict.get(key) for key in self.in_keys]
        return next_tensordict.set("observation", self.module(*inputs))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the key that the transform writes."""
        observation_spec["observation"] = Unbounded(shape=(*observation_spec.shape, self.size))
        return observation_spec
