"""Running observation normalization, with one set of statistics for all robots."""

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs.transforms import Transform


class Normalizer(nn.Module):
    """``clamp((observation - loc) / scale)``; scriptable, and part of the exported policy.

    Args:
        size: Length of an observation.
        clip: Bound of the result, in standard deviations.
    """

    def __init__(self, size: int, clip: float) -> None:
        super().__init__()
        self.clip = clip
        self.loc: Tensor
        self.scale: Tensor
        self.register_buffer("loc", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    def forward(self, observation: Tensor) -> Tensor:
        """Normalize observations [..., size]."""
        return ((observation - self.loc) / self.scale).clamp(-self.clip, self.clip)


class RunningStatistics(nn.Module):
    """Mean and variance of all observations so far, which the learner owns; they renew its ``Normalizer``.

    The normalizer is fixed while a batch is collected; the learner calls ``update`` once per collected batch. The
    statistics are exact (Chan, Golub and LeVeque, "Algorithms for computing the sample variance", 1983), in float64.
    (TorchRL's VecNormV2 counts untouched rows again at partial resets, keeps statistics per robot, and does not freeze
    in evaluation.)

    Args:
        normalizer: What is renewed.
        eps: Lower bound of the scale, in the observation's units.
    """

    def __init__(self, normalizer: Normalizer, eps: float) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.eps = eps
        self.count: Tensor
        self.mean: Tensor
        self.variance: Tensor
        size = len(normalizer.loc)
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))

    @torch.no_grad()
    def update(self, observation: Tensor) -> None:
        """Take a batch of observations [..., size] into the statistics."""
        batch = observation.reshape(-1, observation.shape[-1]).double()
        count = self.count + len(batch)
        variance, mean = torch.var_mean(batch, dim=0, unbiased=False)
        if self.count > 0:
            delta, share = mean - self.mean, len(batch) / count
            variance = self.variance * (1 - share) + variance * share + delta.square() * share * (1 - share)
            mean = self.mean + delta * share
        self.count, self.mean, self.variance = count, mean, variance
        # In place: transforms and collectors refer to the normalizer.
        self.normalizer.loc.copy_(mean)
        self.normalizer.scale.copy_(variance.sqrt()).clamp_(min=self.eps)


class ObservationNormalization(Transform):
    """Writes ``normalized_observation``, as its normalizer makes it of ``observation``.

    Args:
        normalizer: The learner's, or a copy of it.
    """

    def __init__(self, normalizer: Normalizer) -> None:
        super().__init__(in_keys=["observation"], out_keys=["normalized_observation"])
        self.normalizer = normalizer

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("normalized_observation", self.normalizer(next_tensordict.get("observation")))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the key that the transform writes."""
        observation_spec["normalized_observation"] = observation_spec["observation"].clone()
        return observation_spec
