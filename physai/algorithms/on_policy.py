"""On-policy learning: advantages, then some epochs of minibatches, then the batch is forgotten."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchrl.data import TensorDictReplayBuffer

from physai.config import Count, PositiveFloat
from physai.errors import UserError


class NonFiniteError(ArithmeticError):
    """A number is NaN or infinite; ``batch`` is the data that shows it."""

    def __init__(self, what: str, batch: TensorDictBase) -> None:
        super().__init__(what)
        self.batch = batch


# What TorchRL takes at any value, and no training survives.
_RANGES = {
    "gamma": (0.0, 1.0),
    "lmbda": (0.0, 1.0),
    "clip_epsilon": (0.0, 1.0),
    "critic_coeff": (0.0, float("inf")),
    "entropy_coeff": (0.0, float("inf")),
}


class OnPolicy:
    """An on-policy actor-critic algorithm, put together from TorchRL parts (``conf/algo/ppo.yaml``).

    The factories are what ``_partial_: true`` makes of a config node.

    Args:
        actor: The policy; its ``dist_sample_keys`` and ``log_prob_keys`` tell the loss what was sampled.
        critic: The value network.
        frames_per_batch: Size of the batches to come.
        loss: Makes the loss module from ``actor_network`` and ``critic_network``; all its ``loss_*`` outputs are
            summed.
        advantage: Makes the advantage module from ``value_network``.
        buffer: Replay buffer that hands out minibatches; one pass through it is an epoch.
        optimizer: Makes the optimizer from the parameters.
        scheduler: Makes the learning-rate schedule from the optimizer; it steps once a batch.
        epochs: Passes over each batch.
        max_grad_norm: Gradients are clipped to this norm.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        critic: TensorDictModuleBase,
        frames_per_batch: int,
        loss: Callable[..., nn.Module],
        advantage: Callable[..., nn.Module],
        buffer: TensorDictReplayBuffer,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None,
        epochs: Count,
        max_grad_norm: PositiveFloat,
    ) -> None:
        size = buffer.batch_size
        if not isinstance(size, int) or size < 1:
            raise UserError(f"algo.buffer.batch_size: a whole number above 0 is needed, got {size!r}")
        if size > frames_per_batch:
            raise UserError(
                f"algo.buffer.batch_size: a minibatch of {size} is larger than a batch, "
                f"collector.frames_per_batch={frames_per_batch}"
            )
        self.loss: Any = loss(actor_network=actor, critic_network=critic)
        self.advantage = advantage(value_network=critic)
        for where, module in (("loss", self.loss), ("advantage", self.advantage)):
            for name, (low, high) in _RANGES.items():
                value = getattr(module, name, None)
                if value is not None and not low <= float(value) <= high:
                    raise UserError(f"algo.{where}.{name}: must be between {low:g} and {high:g}, got {float(value):g}")
        self.buffer = buffer
        self.optimizer = optimizer(self.loss.parameters())
        self.scheduler = scheduler(self.optimizer) if scheduler is not None else None
        self.epochs = epochs
        self.max_grad_norm = max_grad_norm

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch of frames [N, T]; return means over all minibatches.

        Raises:
            NonFiniteError: If a loss or gradient is not finite; the step is not taken.
        """
        with torch.no_grad():
            self.advantage(batch)
        self.buffer.empty()
        self.buffer.extend(batch.select(*self.loss.in_keys, "advantage", "value_target", strict=False).reshape(-1))
        sums: dict[str, Tensor] = {}
        minibatches = 0
        for _ in range(self.epochs):
            for minibatch in self.buffer:
                losses = self.loss(minibatch)
                total = torch.stack([value for key, value in losses.items() if key.startswith("loss_")]).sum()
                self.optimizer.zero_grad()
                total.backward()
                norm = nn.utils.clip_grad_norm_(self.loss.parameters(), self.max_grad_norm)
                if not torch.isfinite(total) or not torch.isfinite(norm):
                    raise NonFiniteError("the loss" if not torch.isfinite(total) else "the gradient", minibatch)
                self.optimizer.step()
                minibatches += 1
                for key, value in {**losses.detach(), "grad_norm": norm}.items():
                    sums[key] = sums[key] + value if key in sums else value
        metrics = {key: float(value) / minibatches for key, value in sums.items()}
        metrics["lr"] = self.optimizer.param_groups[0]["lr"]
        if self.scheduler is not None:
            self.scheduler.step()
        return metrics

    def state(self) -> dict[str, Any]:
        """Return what ``set_state`` needs to go on bit for bit."""
        return {
            "loss": dict(self.loss.state_dict()),
            "optimizer": self.optimizer.state_dict(),
            "scheduler": None if self.scheduler is None else self.scheduler.state_dict(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self.scheduler is not None:
            self.scheduler.load_state_dict(state["scheduler"])
