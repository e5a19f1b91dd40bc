"""What all algorithms share: gradient steps on a TorchRL loss."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from physai.algorithms.interface import NonFiniteError
from physai.errors import UserError

# What TorchRL takes at any value, and no training survives.
_RANGES = {
    "gamma": (0.0, 1.0),
    "lmbda": (0.0, 1.0),
    "clip_epsilon": (0.0, 1.0),
    "critic_coeff": (0.0, float("inf")),
    "entropy_coeff": (0.0, float("inf")),
}


def check_ranges(where: str, module: nn.Module) -> None:
    """Raise a UserError if a number of a TorchRL module makes no sense.

    Args:
        where: Its key in the config, for the error.
        module: A loss or an advantage.
    """
    for name, (low, high) in _RANGES.items():
        value = getattr(module, name, None)
        if value is not None and not low <= float(value) <= high:
            raise UserError(f"{where}.{name}: must be between {low:g} and {high:g}, got {float(value):g}")


def check_minibatch(minibatch_size: int, frames_per_batch: int) -> None:
    """Raise a UserError if a minibatch is larger than a batch."""
    if minibatch_size > frames_per_batch:
        raise UserError(
            f"algo.minibatch_size: a minibatch of {minibatch_size} is larger than a batch, "
            f"collector.frames_per_batch={frames_per_batch}"
        )


def sequences(frames: TensorDictBase, minibatch_size: int) -> Iterator[TensorDictBase]:
    """Whole rows of frames [N, T], in another order at each call; what is left over at the end is not handed out.

    Args:
        frames: N sequences of T steps.
        minibatch_size: A minibatch is as many sequences as have so many steps, at least one.
    """
    robots, steps = frames.shape
    order = torch.randperm(robots).split(max(1, minibatch_size // steps))
    return (frames[rows] for rows in order if len(rows) == len(order[0]))


class GradientAlgorithm:
    """Follows the gradient of the sum of a loss module's ``loss_*`` outputs.

    Args:
        loss: The module; its state includes target networks.
        optimizer: Makes the optimizer from the parameters.
        scheduler: Makes the learning-rate schedule from the optimizer; None keeps the rate.
        max_grad_norm: Gradients are clipped to this norm.
    """

    def __init__(
        self,
        loss: Any,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None,
        max_grad_norm: float,
    ) -> None:
        check_ranges("algo.loss", loss)
        self.loss = loss
        self._parameters = list(loss.parameters())  # finding them takes longer than clipping them
        self.optimizer = optimizer(self._parameters)
        self.scheduler = scheduler(self.optimizer) if scheduler is not None else None
        self._max_grad_norm = max_grad_norm

    def step(self, losses: TensorDictBase, minibatch: TensorDictBase, leave_out: str = "") -> Tensor:
        """Take a step on the losses of a minibatch, but for the one that is left out; return the gradient's norm.

        Raises:
            NonFiniteError: If a loss or gradient is not finite; the step is not taken.
        """
        terms = [value for key, value in losses.items() if key.startswith("loss_") and key != leave_out]
        total = torch.stack(terms).sum()
        self.optimizer.zero_grad()
        total.backward()
        norm = nn.utils.clip_grad_norm_(self._parameters, self._max_grad_norm)
        if not torch.isfinite(total + norm):
            raise NonFiniteError("the gradient" if torch.isfinite(total) else "the loss", minibatch)
        self.optimizer.step()
        return norm

    def end_batch(self) -> float:
        """Let the schedule go on; return the learning rate that there was."""
        rate: float = self.optimizer.param_groups[0]["lr"]
        if self.scheduler is not None:
            self.scheduler.step()
        return rate

    def weights(self) -> dict[str, Tensor]:
        """All weights by name, target networks included."""
        return dict(self.loss.state_dict())

    def state(self) -> dict[str, Any]:
        """Return what ``set_state`` needs to go on bit for bit."""
        return {
            "loss": self.weights(),
            "optimizer": self.optimizer.state_dict(),
            "scheduler": None if self.scheduler is None else self.scheduler.state_dict(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self.scheduler is not None:
            self.scheduler.load_state_dict(state["scheduler"])
