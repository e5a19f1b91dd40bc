"""Actors of off-policy algorithms: their actions are squashed by tanh, and learned from as such."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform
from torchrl.data import Bounded, Composite
from torchrl.envs.utils import ExplorationType, exploration_type

from physai.config import Count, NonNegativeFloat
from physai.policies.networks import mlp, side_by_side

_LOG_STD = (-5.0, 2.0)


class TanhGaussianActor(TensorDictModuleBase):
    """Draws ``action`` [.., n] in (-1, 1) from a squashed normal distribution whose deviation depends on the state.

    The actor of Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", 2018. In the deterministic
    exploration mode the action is that of the mean.

    Args:
        in_features: Numbers that ``in_keys`` bring.
        action_size: n.
        in_keys: Keys that the actor sees.
        hidden_sizes: Widths of the hidden layers, at least one.
        activation: A ``torch.nn`` module's name.
    """

    # Where TorchRL's losses look for what was sampled:
    dist_sample_keys = ("action",)
    log_prob_keys = ("action_log_prob",)
    out_keys = ("action",)

    def __init__(
        self, in_features: int, action_size: int, in_keys: list[str], hidden_sizes: list[Count], activation: str
    ) -> None:
        super().__init__()
        self.in_keys = in_keys
        self.spec = Composite(action=Bounded(-1.0, 1.0, (action_size,)))  # its size gives SACLoss a target entropy
        self.network = mlp(in_features, hidden_sizes, 2 * action_size, activation, orthogonal=False)

    def deterministic(self) -> nn.Module:
        """What acts without exploration, scriptable: ``in_keys`` side by side, [N, in_features], to actions [N, n]."""
        return nn.Sequential(*self.network, _FirstHalf(), nn.Tanh())

    def _mean_and_std(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        mean, log_std = self.network(side_by_side(tensordict, self.in_keys)).chunk(2, dim=-1)
        return mean, log_std.clamp(*_LOG_STD).exp()

    def get_dist(self, tensordict: TensorDictBase) -> Distribution:
        """Return the distribution of the action."""
        normal = Independent(Normal(*self._mean_and_std(tensordict), validate_args=False), 1, validate_args=False)
        # The cache spares the inverse of tanh, which is not exact where tanh saturates.
        return TransformedDistribution(normal, TanhTransform(cache_size=1), validate_args=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act."""
        mean, std = self._mean_and_std(tensordict)
        if exploration_type() == ExplorationType.RANDOM:
            mean = torch.addcmul(mean, std, torch.randn_like(mean))
        return tensordict.set("action", torch.tanh(mean))


class _FirstHalf(nn.Module):
    """The mean of what the network says; a layer for the mean alone would round it otherwise."""

    def forward(self, output: Tensor) -> Tensor:
        return output.chunk(2, dim=-1)[0]


class DeterministicActor(TensorDictModuleBase):
    """Writes ``action`` [.., n] in [-1, 1]; in the random exploration mode with normal noise on it.

    The actor of Lillicrap et al., "Continuous control with deep reinforcement learning", 2015, and of Fujimoto et al.,
    "Addressing Function Approximation Error in Actor-Critic Methods", 2018.

    Args:
        in_features: Numbers that ``in_keys`` bring.
        action_size: n.
        in_keys: Keys that the actor sees.
        hidden_sizes: Widths of the hidden layers.
        activation: A ``torch.nn`` module's name.
        exploration_std: Standard deviation of the noise.
    """

    out_keys = ("action",)

    def __init__(
        self,
        in_features: int,
        action_size: int,
        in_keys: list[str],
        hidden_sizes: list[Count],
        activation: str,
        exploration_std: NonNegativeFloat,
    ) -> None:
        super().__init__()
        self.in_keys = in_keys
        self.network = mlp(in_features, hidden_sizes, action_size, activation, orthogonal=False)
        self.exploration_std = exploration_std

    def deterministic(self) -> nn.Module:
        """What acts without exploration, scriptable: ``in_keys`` side by side, [N, in_features], to actions [N, n]."""
        return nn.Sequential(*self.network, nn.Tanh())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act."""
        action = torch.tanh(self.network(side_by_side(tensordict, self.in_keys)))
        if exploration_type() == ExplorationType.RANDOM:
            action = torch.add(action, torch.randn_like(action), alpha=self.exploration_std).clamp(-1.0, 1.0)
        return tensordict.set("action", action)
