"""Multilayer perceptrons that act and judge."""

import importlib
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.data import Composite
from torchrl.envs.utils import ExplorationType, exploration_type

from physai.config import Count, PositiveFloat, nearest
from physai.errors import UserError
from physai.policies.distributions import HALF_LOG_TWO_PI, DiagonalNormal


def input_size(observation_spec: Composite, in_keys: Any, where: str) -> int:
    """Return how many numbers ``in_keys`` of an env bring, or raise a UserError that says where a key is wrong."""
    if not isinstance(in_keys, list) or not all(isinstance(key, str) for key in in_keys):
        raise UserError(f"{where}.in_keys: a list of keys of the env is needed")
    for key in in_keys:
        given = list(observation_spec.keys())
        if key not in given:
            raise UserError(f"{where}.in_keys: the env gives no '{key}'{nearest(key, given)}")
    return sum(observation_spec[key].shape[-1] for key in in_keys)


def mlp(
    in_features: int,
    hidden_sizes: Sequence[int],
    out_features: int,
    activation: str,
    last_gain: float = 1.0,
    orthogonal: bool = True,
) -> nn.Sequential:
    """Build a perceptron.

    Args:
        in_features: Numbers that go in.
        hidden_sizes: Widths of the hidden layers.
        out_features: Numbers that come out.
        activation: A ``torch.nn`` module's name.
        last_gain: Of the weights of the last layer, if they are orthogonal.
        orthogonal: Orthogonal weights (Saxe et al., 2014) and zero biases, as on-policy algorithms like them; else
            torch's own, uniform ones.
    """
    module, _, name = activation.rpartition(".")
    nonlinearity = getattr(importlib.import_module(module or "torch.nn"), name)
    linear = _linear if orthogonal else lambda inputs, outputs, _: nn.Linear(inputs, outputs)
    layers: list[nn.Module] = []
    for size in hidden_sizes:
        layers += [linear(in_features, size, 2**0.5), nonlinearity()]
        in_features = size
    return nn.Sequential(*layers, linear(in_features, out_features, last_gain))


def _linear(in_features: int, out_features: int, gain: float) -> nn.Linear:
    layer = nn.Linear(in_features, out_features)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class GaussianActor(TensorDictModuleBase):
    """Draws ``latent_action`` from a diagonal normal distribution and acts with ``action = tanh(latent_action)``.

    Learning on the latent sample is the same policy gradient as on the squashed one, for the change of variables has no
    parameters and cancels in the probability ratio; but it has an exact log-probability where tanh saturates, and a
    closed-form entropy. In the deterministic exploration mode the latent action is the mean.

    Writes ``action`` [.., n] in (-1, 1), ``latent_action`` [.., n] and ``action_log_prob`` [..] (that of the latent
    action).

    Args:
        in_features: Numbers that ``in_keys`` bring.
        action_size: n.
        in_keys: Keys that the actor sees.
        hidden_sizes: Widths of the hidden layers.
        activation: A ``torch.nn`` module's name.
        initial_std: Standard deviation of the first policy.
    """

    out_keys: tuple[str, ...] = ("action", "latent_action", "action_log_prob")
    # Where TorchRL's losses look for what was sampled:
    dist_sample_keys = ("latent_action",)
    log_prob_keys = ("action_log_prob",)

    def __init__(
        self,
        in_features: int,
        action_size: int,
        in_keys: list[str],
        hidden_sizes: list[Count],
        activation: str,
        initial_std: PositiveFloat,
    ) -> None:
        super().__init__()
        self.in_keys = in_keys
        self.network = mlp(in_features, hidden_sizes, action_size, activation, last_gain=0.01)  # start near standstill
        self.log_std = nn.Parameter(torch.full((action_size,), initial_std).log())

    def deterministic(self) -> nn.Module:
        """What acts without exploration, scriptable: ``in_keys`` side by side, [N, in_features], to actions [N, n]."""
        return nn.Sequential(*self.network, nn.Tanh())

    def mean(self, tensordict: TensorDictBase) -> Tensor:
        """Mean of the latent action, [.., n]."""
        return self.network(side_by_side(tensordict, self.in_keys))

    def get_dist(self, tensordict: TensorDictBase) -> Distribution:
        """Return the distribution of the latent action."""
        return DiagonalNormal(self.mean(tensordict), self.log_std)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act."""
        return self.act(tensordict, self.mean(tensordict))

    def act(self, tensordict: TensorDictBase, mean: Tensor) -> TensorDictBase:
        """Draw around a mean of the latent action, [.., n]."""
        noise = torch.randn_like(mean) if exploration_type() == ExplorationType.RANDOM else torch.zeros_like(mean)
        latent = torch.addcmul(mean, self.log_std.exp(), noise)
        log_prob = -0.5 * noise.square().sum(-1) - (self.log_std + HALF_LOG_TWO_PI).sum()
        tensordict.set("action", torch.tanh(latent))
        tensordict.set("latent_action", latent)
        return tensordict.set("action_log_prob", log_prob)


class ResidualActor(GaussianActor):
    """A :class:`GaussianActor` that adds to what its task suggests (``suggests`` of its observation module).

    After Johannink et al., "Residual Reinforcement Learning for Robot Control", ICRA 2019: the suggestion solves most
    of the task, and the network learns the rest. The suggestion is the last n of the numbers that it sees, so
    ``features`` are the last of its keys.

    Args:
        in_features: Numbers that ``in_keys`` bring.
        action_size: n.
        *args: Those of :class:`GaussianActor`, from ``in_keys`` on.
        scale: How much of its output the network adds. Less than 1 for a good suggestion: the actor then learns more
            slowly than the critic, whose learning rate is the same.
        **kwargs: The same by name.
    """

    residual = True

    def __init__(
        self, in_features: int, action_size: int, *args: Any, scale: PositiveFloat = 1.0, **kwargs: Any
    ) -> None:
        super().__init__(in_features, action_size, *args, **kwargs)
        if self.in_keys[-1] != "features":
            raise UserError("policy.actor.in_keys: the last must be features, which end with what the task suggests")
        self.network = nn.Sequential(Residual(self.network, action_size, scale))


class Residual(nn.Module):
    """Adds the last inputs to what a network makes of all of them.

    Args:
        network: Maps [.., in_features] to [.., size].
        size: How many.
        scale: Of what the network makes.
    """

    def __init__(self, network: nn.Module, size: int, scale: float = 1.0) -> None:
        super().__init__()
        self.network = network
        self.size = size
        self.scale = scale

    def forward(self, seen: Tensor) -> Tensor:
        """Map [.., in_features] to [.., size]."""
        return torch.add(seen[..., -self.size :], self.network(seen), alpha=self.scale)


class Critic(TensorDictModuleBase):
    """Writes the expected return [.., 1]: ``state_value``, or ``state_action_value`` if it sees ``action``.

    Args:
        in_features: Numbers that ``in_keys`` bring.
        in_keys: Keys that the critic sees; ``physics_parameters`` among them make it a privileged one.
        hidden_sizes: Widths of the hidden layers.
        activation: A ``torch.nn`` module's name.
    """

    def __init__(
        self,
        in_features: int,
        in_keys: list[str],
        hidden_sizes: list[Count],
        activation: str,
    ) -> None:
        super().__init__()
        self.in_keys = in_keys
        judges_actions = "action" in in_keys
        self.out_keys = ["state_action_value" if judges_actions else "state_value"]
        # TorchRL draws the weights of twin critics anew, uniformly, from the range that it finds.
        self.network = mlp(in_features, hidden_sizes, 1, activation, orthogonal=not judges_actions)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Judge."""
        return tensordict.set(self.out_keys[0], self.network(side_by_side(tensordict, self.in_keys)))


def side_by_side(tensordict: TensorDictBase, in_keys: Sequence[str]) -> Tensor:
    """Return what a network sees: the values of its keys, [.., in_features]."""
    values = [tensordict.get(key) for key in in_keys]
    return values[0] if len(values) == 1 else torch.cat(values, dim=-1)
