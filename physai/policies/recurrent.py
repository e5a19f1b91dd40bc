"""Policies that remember: what they did, and what a gated recurrent unit makes of all that they saw."""

from typing import Annotated, Any

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor, nn

from physai.config import Count
from physai.policies.networks import GaussianActor, side_by_side


class HistoryActor(GaussianActor):
    """A :class:`GaussianActor` that also sees its last actions.

    A command that comes late, by an actuator delay, is on its way while the policy acts again: without its last actions
    a policy does not see the whole state (Katsikopoulos and Engelbrecht, "Markov Decision Processes with Delays and
    Asynchronous Cost Collection", 2003).

    It reads ``memory`` [N, H], which is zero where an episode begins, and writes ``new_memory`` [N, H] beside the
    actions: the last ones, newest first.

    Args:
        in_features: Numbers that ``in_keys`` bring.
        action_size: n.
        *args: Those of :class:`GaussianActor`, from ``in_keys`` on.
        past_actions: How many actions it sees, k; the memory is H = k n numbers.
        **kwargs: The same by name.

    Attributes:
        seen_keys: ``in_keys`` as given; ``in_keys`` holds what else the actor reads, too.
        memory_size: H.
        units: Numbers of the memory that are no actions; they come first.
    """

    out_keys = (*GaussianActor.out_keys, "new_memory")

    def __init__(
        self,
        in_features: int,
        action_size: int,
        *args: Any,
        past_actions: Annotated[int, Field(ge=0)],
        **kwargs: Any,
    ) -> None:
        actions = past_actions * action_size
        super().__init__(in_features + actions, action_size, *args, **kwargs)
        self.units, self.memory_size = 0, actions
        self.seen_keys = self.in_keys
        self.in_keys = [*self.seen_keys, "memory"]

    def deterministic(self) -> nn.Module:
        """What acts without exploration, scriptable.

        It maps the seen keys side by side, [N, in_features], and a memory [N, H] to actions [N, n] and the new memory.
        """
        return History(super().deterministic())

    def seen(self, tensordict: TensorDictBase) -> Tensor:
        """What it sees, last actions included, [.., in_features + k n]."""
        return torch.cat([side_by_side(tensordict, self.seen_keys), tensordict.get("memory")[..., self.units :]], -1)

    def mean(self, tensordict: TensorDictBase) -> Tensor:
        """Mean of the latent action, [.., n]."""
        return self.network(self.seen(tensordict))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act, one step."""
        acted = super().forward(tensordict)
        return acted.set("new_memory", shift(acted.get("memory"), acted.get("action")))


class GRUActor(HistoryActor):
    """A :class:`HistoryActor` that also sees what a gated recurrent unit (Cho et al., 2014) remembers of the episode.

    The perceptron sees ``in_keys``, the last actions and what the unit makes of both, side by side: what needs no
    memory is learnt as quickly as without one.

    In learning, batches are sequences [M, T]: the distribution is that of the memory which the weights of now make of
    the sequence, from the ``memory`` at its beginning, and from zero wherever ``episode_length`` says that another
    episode begins.

    Args:
        in_features: Numbers that ``in_keys`` bring.
        action_size: n.
        *args: Those of :class:`GaussianActor`, from ``in_keys`` on.
        memory_size: Numbers that the unit remembers; in the memory they come before the last actions.
        past_actions: How many actions it sees, k; the memory is H = memory_size + k n numbers.
        **kwargs: The same by name.
    """

    def __init__(
        self,
        in_features: int,
        action_size: int,
        *args: Any,
        memory_size: Count,
        past_actions: Annotated[int, Field(ge=0)],
        **kwargs: Any,
    ) -> None:
        super().__init__(in_features + memory_size, action_size, *args, past_actions=past_actions, **kwargs)
        self.cell = nn.GRUCell(in_features + self.memory_size, memory_size)
        nn.init.orthogonal_(self.cell.weight_hh)
        self.units = memory_size
        self.memory_size += memory_size
        self.in_keys += ["episode_length"]

    def deterministic(self) -> nn.Module:
        """See :class:`HistoryActor`."""
        return Recurrent(self.cell, GaussianActor.deterministic(self))

    def mean(self, tensordict: TensorDictBase) -> Tensor:
        """Mean of the latent action, [.., n], of single steps [N] or of sequences [M, T]."""
        seen, memory = self.seen(tensordict), tensordict.get("memory")[..., : self.units]
        if seen.ndim == 2:
            return self._mean(seen, self.cell(seen, memory))
        goes_on = tensordict.get("episode_length") > 0
        return self._mean(seen, self.unroll(seen, memory[:, 0], goes_on))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act, one step."""
        seen, before = self.seen(tensordict), tensordict.get("memory")
        memory = self.cell(seen, before[..., : self.units])
        acted = self.act(tensordict, self._mean(seen, memory))
        recent = shift(before[..., self.units :], acted.get("action"))
        return acted.set("new_memory", torch.cat([memory, recent], dim=-1))

    def unroll(self, seen: Tensor, memory: Tensor, goes_on: Tensor) -> Tensor:
        """Remember sequences.

        Args:
            seen: What is seen, [M, T, in_features + k n].
            memory: Of the unit before the first step, [M, memory_size].
            goes_on: Whether a step belongs to the episode of the step before it, [M, T, 1]; the first is not asked.

        Returns:
            What the unit remembers after each step, [M, T, memory_size].
        """
        memories = []
        for step, (now, keep) in enumerate(zip(seen.unbind(1), goes_on.unbind(1), strict=True)):
            memory = self.cell(now, memory * keep if step else memory)
            memories.append(memory)
        return torch.stack(memories, dim=1)

    def _mean(self, seen: Tensor, memory: Tensor) -> Tensor:
        return self.network(torch.cat([seen, memory], dim=-1))


def shift(recent: Tensor, action: Tensor) -> Tensor:
    """Put an action [N, n] before the last ones, [N, k n]; the oldest goes."""
    return torch.cat([action, recent], dim=1)[:, : recent.shape[1]]


class History(nn.Module):
    """What acts without exploration: a perceptron that sees its last actions.

    Args:
        network: Maps what is seen and the last actions, side by side, to actions.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, seen: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Map what is seen [N, in_features] and a memory [N, H] to actions [N, n] and the new memory."""
        action = self.network(torch.cat([seen, memory], dim=1))
        return action, shift(memory, action)


class Recurrent(nn.Module):
    """What acts without exploration: cell and perceptron.

    Args:
        cell: Maps what is seen, with the last actions, and what it remembers to what it remembers then.
        network: Maps what is seen, with the last actions, and what the cell remembers, side by side, to actions.
    """

    def __init__(self, cell: nn.GRUCell, network: nn.Module) -> None:
        super().__init__()
        self.cell = cell
        self.network = network
        self.units = cell.hidden_size

    def forward(self, seen: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Map what is seen [N, in_features] and a memory [N, H] to actions [N, n] and the new memory."""
        recent = memory[:, self.units :]
        seen = torch.cat([seen, recent], dim=1)
        remembered = self.cell(seen, memory[:, : self.units])
        action = self.network(torch.cat([seen, remembered], dim=1))
        return action, torch.cat([remembered, shift(recent, action)], dim=1)
