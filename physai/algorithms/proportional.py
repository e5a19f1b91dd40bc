"""Prioritized replay."""

from typing import Any

import torch
from torch import Tensor
from torchrl.data.replay_buffers import Storage
from torchrl.data.replay_buffers.samplers import Sampler

from physai.config import NonNegativeFloat

_EPS = 1e-6  # added to each priority: no frame is never drawn again


class ProportionalSampler(Sampler):
    """Draws frames in proportion to ``(|TD error| + eps) ** alpha``.

    Proportional prioritization of Schaul et al., "Prioritized Experience Replay", 2016.

    New frames have the highest priority that there was. Importance weights, ``(n p) ** -beta`` in units of the largest
    one drawn, are handed out as ``priority_weight``, which TorchRL's losses take. (TorchRL's ``PrioritizedSampler``
    keeps its priorities in a compiled tree, and that of TorchRL 0.14.1 does not load with PyTorch 2.13. Here one draw
    serves a whole batch of gradient steps, and for that a cumulative sum is quick enough.)

    Args:
        alpha: How much priorities count; 0 draws uniformly.
        beta: How much of the bias is made up for; 1 is all of it.
    """

    def __init__(self, alpha: NonNegativeFloat, beta: NonNegativeFloat) -> None:
        self.alpha, self.beta = alpha, beta
        self.priorities: Tensor
        self._highest: float
        self._empty()

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draw indices [batch_size]."""
        cumulative = self.priorities[: len(storage)].cumsum(0)
        draw = torch.rand(batch_size, generator=self._rng, dtype=torch.float64)
        index = torch.searchsorted(cumulative, draw * cumulative[-1]).clamp_(max=len(storage) - 1)
        weight = self.priorities[index].pow(-self.beta)
        return index, {"priority_weight": (weight / weight.max()).float()}

    def extend(self, index: Tensor) -> None:
        """Give new frames the highest priority."""
        missing = int(index.max()) + 1 - len(self.priorities)
        if missing > 0:
            self.priorities = torch.cat([self.priorities, torch.zeros(missing, dtype=torch.float64)])
        self.priorities[index] = self._highest

    def update_priority(self, index: Any, priority: Any, *, storage: Storage | None = None) -> None:
        """Set the priorities of frames to their TD errors."""
        new = (torch.as_tensor(priority).double().cpu().abs() + _EPS) ** self.alpha
        self.priorities[torch.as_tensor(index).cpu()] = new
        self._highest = max(self._highest, float(new.max()))

    def state_dict(self) -> dict[str, Any]:
        """Return all priorities."""
        return {"priorities": self.priorities.clone(), "highest": self._highest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.priorities, self._highest = state_dict["priorities"].clone(), state_dict["highest"]

    def _empty(self) -> None:
        self.priorities = torch.zeros(0, dtype=torch.float64)
        self._highest = 1.0

    def dumps(self, path: Any) -> None:
        """Refuse: a run's checkpoint holds ``state_dict``."""
        raise NotImplementedError

    def loads(self, path: Any) -> None:
        """Refuse."""
        raise NotImplementedError
