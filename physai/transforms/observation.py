"""The policy's view: what a robot senses and its goal become the task's observation."""

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from physai.tasks import ObservationModule


class Observation(Transform):
    """Writes ``observation`` and ``features`` from what the task's module maps.

    Args:
        module: The task's observation module, the same that the exported policy carries.
    """

    def __init__(self, module: ObservationModule) -> None:
        super().__init__(in_keys=[*module.senses, "goal"], out_keys=["observation", "features"])
        self.module = module

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        observation, features = self.module(*(next_tensordict.get(key) for key in self.in_keys))
        return next_tensordict.set("observation", observation).set("features", features)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)

    @torch.no_grad()
    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the keys that the transform writes."""
        values = self.module(*(observation_spec[key].zero() for key in self.in_keys))
        for key, value in zip(self.out_keys, values, strict=True):
            observation_spec[key] = Unbounded(shape=value.shape)
        return observation_spec
