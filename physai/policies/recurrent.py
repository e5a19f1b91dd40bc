"""A policy that remembers: a gated recurrent unit beside the perceptron."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from physai.config import Count
from physai.policies.networks import GaussianActor, side_by_side


class GRUActor(GaussianActor):
    """A :class:`GaussianActor` that also sees what a gated recurrent unit (Cho et al., 2014) remembers of the episode.

    It reads ``memory`` [N, H], which is zero where an episode begins, and writes ``new_memory`` [N, H] beside the
    actions. The perceptron sees ``in_keys`` and the new memory, side by side: what needs no memory is learnt as quickly
    as without one.

    In learning, batches are sequences [M, T]: the distribution is that of the memory which the weights of now make of
    the sequence, from the ``memory`` at its beginning, and from zero wherever ``episode_length`` says that another
    episode begins.

    Args:
        in_features: Numbers that ``in_keys`` bring.
        *args: Those of :class:`GaussianActor`, from ``action_size`` on.
        memory_size: H.
        **kwargs: The same by name.

    Attributes:
        seen_keys: ``in_keys`` as given; ``in_keys`` holds what else the actor reads, too.
    """

    out_keys = (*GaussianActor.out_keys, "new_memory")

    def __init__(self, in_features: int, *args: Any, memory_size: Count, **kwargs: Any) -> None:
        super().__init__(in_features + memory_size, *args, **kwargs)
        self.memory_size = memory_size
        self.cell = nn.GRUCell(in_features, memory_size)
        nn.init.orthogonal_(self.cell.weight_hh)
        self.seen_keys = self.in_keys
        self.in_keys = [*self.seen_keys, "memory", "episode_length"]

    def deterministic(self) -> nn.Module:
        """What acts without exploration, scriptable.

        It maps the seen keys side by side, [N, in_features], and a memory [N, H] to actions [N, n] and the new memory.
        """
        return Recurrent(self.cell, super().deterministic())

    def mean(self, tensordict: TensorDictBase) -> Tensor:
        """Mean of the latent action, [.., n], of single steps [N] or of sequences [M, T]."""
        seen, memory = side_by_side(tensordict, self.seen_keys), tensordict.get("memory")
        if seen.ndim == 2:
            return self._mean(seen, self.cell(seen, memory))
        goes_on = tensordict.get("episode_length") > 0
        return self._mean(seen, self.unroll(seen, memory[:, 0], goes_on))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act, one step."""
        seen = side_by_side(tensordict, self.seen_keys)
        memory = self.cell(seen, tensordict.get("memory"))
        return self.act(tensordict.set("new_memory", memory), self._mean(seen, memory))

    def unroll(self, seen: Tensor, memory: Tensor, goes_on: Tensor) -> Tensor:
        """Remember sequences.

        Args:
            seen: What is seen, [M, T, in_features].
            memory: Before the first step, [M, H].
            goes_on: Whether a step belongs to the episode of the step before it, [M, T, 1]; the first is not asked.

        Returns:
            The memory after each step, [M, T, H].
        """
        memories = []
        for step, (now, keep) in enumerate(zip(seen.unbind(1), goes_on.unbind(1), strict=True)):
            memory = self.cell(now, memory * keep if step else memory)
            memories.append(memory)
        return torch.stack(memories, dim=1)

    def _mean(self, seen: Tensor, memory: Tensor) -> Tensor:
        return self.network(torch.cat([seen, memory], dim=-1))


class Recurrent(nn.Module):
    """What acts without exploration: cell and perceptron.

    Args:
        cell: Maps what is seen and the memory to the new memory.
        network: Maps what is seen and the new memory, side by side, to actions.
    """

    def __init__(self, cell: nn.GRUCell, network: nn.Module) -> None:
        super().__init__()
        self.cell = cell
        self.network = network

    def forward(self, seen: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Map what is seen [N, in_features] and a memory [N, H] to actions [N, n] and the new memory."""
        memory = self.cell(seen, memory)
        return self.network(torch.cat([seen, memory], dim=1)), memory
