"""On-policy learning: advantages, then some epochs of minibatches, then the batch is forgotten."""

from collections.abc import Callable, Iterator
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
        buffer: Replay buffer that hands out a batch in another order for each epoch.
        minibatch_size: Samples of a gradient step; what is left over at the end of an epoch is not used.
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
        loss: Callable[..., Any],
        advantage: Callable[..., Any],
        buffer: TensorDictReplayBuffer,
        minibatch_size: Count,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None,
        epochs: Count,
        max_grad_norm: PositiveFloat,
    ) -> None:
        if minibatch_size > frames_per_batch:
            raise UserError(
                f"algo.minibatch_size: a minibatch of {minibatch_size} is larger than a batch, "
                f"collector.frames_per_batch={frames_per_batch}"
            )
        drawn, held = buffer.batch_size, buffer.storage.max_size
        if drawn != frames_per_batch or held < frames_per_batch:
            raise UserError(
                f"algo.buffer: batch_size ({drawn}) and storage.max_size ({held}) must be "
                f"collector.frames_per_batch ({frames_per_batch}); minibatches are algo.minibatch_size"
            )
        self.loss = loss(actor_network=actor, critic_network=critic)
        self.advantage = advantage(value_network=critic)
        for where, module in (("loss", self.loss), ("advantage", self.advantage)):
            for name, (low, high) in _RANGES.items():
                value = getattr(module, name, None)
                if value is not None and not low <= float(value) <= high:
                    raise UserError(f"algo.{where}.{name}: must be between {low:g} and {high:g}, got {float(value):g}")
        self.buffer = buffer
        self.minibatch_size = minibatch_size
        # What comes after a frame has done its part once there are advantages; each key is gathered in each epoch.
        now = [key for key in self.loss.in_keys if not (isinstance(key, tuple) and key[0] == "next")]
        self._judged = self.advantage.tensor_keys.value, self.advantage.tensor_keys.value_target
        self._keys = [*now, self.advantage.tensor_keys.advantage, *self._judged]
        self._parameters = list(self.loss.parameters())  # finding them takes longer than clipping them
        self.optimizer = optimizer(self._parameters)
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
        self.buffer.extend(batch.select(*self._keys, strict=False).reshape(-1))
        results: list[TensorDictBase] = []
        for _ in range(self.epochs):
            for minibatch in self._minibatches():
                losses = self.loss(minibatch)
                total = torch.stack([value for key, value in losses.items() if key.startswith("loss_")]).sum()
                self.optimizer.zero_grad()
                total.backward()
                norm = nn.utils.clip_grad_norm_(self._parameters, self.max_grad_norm)
                if not torch.isfinite(total + norm):
                    raise NonFiniteError("the gradient" if torch.isfinite(total) else "the loss", minibatch)
                self.optimizer.step()
                results.append(losses.set("grad_norm", norm))
        with torch.no_grad():
            means: TensorDictBase = torch.stack(results).mean(dim=0)
            metrics = {key: float(value) for key, value in means.items()}
            metrics["explained_variance"] = _explained_variance(*(batch.get(key) for key in self._judged))
        metrics["lr"] = self.optimizer.param_groups[0]["lr"]
        if self.scheduler is not None:
            self.scheduler.step()
        return metrics

    def _minibatches(self) -> Iterator[TensorDictBase]:
        # One draw an epoch, and slices of it: drawing each minibatch from the buffer takes eight times as long.
        shuffled, size = self.buffer.sample(), self.minibatch_size
        return (shuffled[start : start + size] for start in range(0, len(shuffled) - size + 1, size))

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


def _explained_variance(value: Tensor, target: Tensor) -> float:
    """Share of the variance of returns that the critic foresaw; 0 is no better than a constant."""
    return 1.0 - float((target - value).var() / target.var().clamp(min=torch.finfo(target.dtype).eps))
