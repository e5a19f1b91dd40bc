"""On-policy learning: advantages, then some epochs of minibatches, then the batch is forgotten."""

from collections.abc import Callable, Iterator
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchrl.data import TensorDictReplayBuffer

from physai.algorithms.gradient import GradientAlgorithm, check_minibatch, check_ranges, sequences
from physai.algorithms.interface import Networks
from physai.config import Count, PositiveFloat
from physai.errors import UserError

_RATES = 1e-5, 1e-3  # of learning, if it follows from how far the policy moves


class OnPolicy(GradientAlgorithm):
    """An on-policy actor-critic algorithm, put together from TorchRL parts (``conf/algo/ppo.yaml``).

    It is a :class:`physai.algorithms.Algorithm`. The factories are what ``_partial_: true`` makes of a config node.

    Args:
        networks: The critic judges states.
        frames_per_batch: Size of the batches to come.
        loss: Makes the loss module from ``actor_network`` and ``critic_network``; all its ``loss_*`` outputs are
            summed.
        advantage: Makes the advantage module from ``value_network``.
        buffer: Replay buffer that hands out a batch in another order for each epoch; not of an actor that remembers.
        minibatch_size: Samples of a gradient step; what is left over at the end of an epoch is not used. An actor that
            remembers learns from whole sequences: as many as have so many samples, at least one.
        optimizer: Makes the optimizer from the parameters.
        scheduler: Makes the learning-rate schedule from the optimizer; it steps once a batch.
        epochs: Passes over each batch.
        max_grad_norm: Gradients are clipped to this norm.
        target_kl: How far the policy shall move in a batch, nats (``kl_approx``, the mean over all its minibatches):
            twice as far makes the learning rate 1.5 times smaller, half as far 1.5 times larger, within 1e-5 and 1e-3
            (Rudin et al., "Learning to Walk in Minutes Using Massively Parallel Deep Reinforcement Learning", CoRL
            2021). None leaves the rate to the schedule.
        symmetry: Learn from the mirror image of each frame, too: a minibatch comes with its own, as large as itself
            (Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024). Of
            robots on legs, and of actors that do not remember.
    """

    warmup_frames = 0

    def __init__(
        self,
        networks: Networks,
        frames_per_batch: int,
        loss: Callable[..., Any],
        advantage: Callable[..., Any],
        buffer: TensorDictReplayBuffer,
        minibatch_size: Count,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None,
        epochs: Count,
        max_grad_norm: PositiveFloat,
        target_kl: PositiveFloat | None = None,
        symmetry: bool = False,
    ) -> None:
        check_minibatch(minibatch_size, frames_per_batch)
        drawn, held = buffer.batch_size, buffer.storage.max_size
        if drawn != frames_per_batch or held < frames_per_batch:
            raise UserError(
                f"algo.buffer: batch_size ({drawn}) and storage.max_size ({held}) must be "
                f"collector.frames_per_batch ({frames_per_batch}); minibatches are algo.minibatch_size"
            )
        if "state_value" not in networks.critic.out_keys:
            raise UserError("policy.critic.in_keys: this algorithm's critic judges states: it must not see 'action'")
        made = loss(actor_network=networks.actor, critic_network=networks.critic)
        self.advantage = advantage(value_network=networks.critic)
        check_ranges("algo.advantage", self.advantage)
        super().__init__(made, optimizer, scheduler, max_grad_norm)
        if target_kl is not None and "kl_approx" not in self.loss.out_keys:
            raise UserError("algo.target_kl: this loss does not say how far the policy moves ('kl_approx')")
        self._target_kl = target_kl
        self.buffer = buffer
        self.minibatch_size = minibatch_size
        self._device = networks.device
        self._in_sequences = getattr(networks.actor, "memory_size", 0) > 0
        if symmetry and self._in_sequences:
            raise UserError("algo.symmetry: what an actor remembers has no mirror image")
        try:
            self._mirror = networks.mirror() if symmetry else None
        except UserError as error:
            raise UserError(f"algo.symmetry: {error}") from error
        # What comes after a frame has done its part once there are advantages; each key is gathered in each epoch.
        now = [key for key in self.loss.in_keys if not (isinstance(key, tuple) and key[0] == "next")]
        self._judged = self.advantage.tensor_keys.value, self.advantage.tensor_keys.value_target
        self._keys = [*now, self.advantage.tensor_keys.advantage, *self._judged]
        self.epochs = epochs

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch of frames [N, T]; return means over all minibatches.

        Raises:
            NonFiniteError: If a loss or gradient is not finite; the step is not taken.
        """
        image = None if self._mirror is None else self._mirror(batch.exclude("next"))
        if self._device.type != "cpu":
            batch = batch.to(self._device)
        with torch.no_grad():
            self.advantage(batch)
        frames = batch.select(*self._keys, strict=False)
        if image is not None:
            frames.set("image", image.select(*self._keys, strict=False).to(self._device))
        if not self._in_sequences:
            self.buffer.empty()
            self.buffer.extend(frames.reshape(-1))
        results: list[TensorDictBase] = []
        for _ in range(self.epochs):
            in_order = sequences(frames, self.minibatch_size) if self._in_sequences else self._minibatches()
            for minibatch in in_order:
                losses = self._losses(minibatch)
                results.append(losses.set("grad_norm", self.step(losses, minibatch)))
        with torch.no_grad():
            means: TensorDictBase = torch.stack(results).mean(dim=0)
            metrics = {key: float(value) for key, value in means.items()}
            metrics["explained_variance"] = _explained_variance(*(batch.get(key) for key in self._judged))
        metrics["lr"] = self.end_batch()
        if self._target_kl is not None:
            self._adapt(metrics["kl_approx"] / self._target_kl)
        return metrics

    def _losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return losses, with those of the mirror images in equal parts, and figures about the frames themselves."""
        if self._mirror is None:
            return cast("TensorDictBase", self.loss(minibatch))
        own = minibatch.exclude("image")
        losses, others = (self.loss(each) for each in (own, own.copy().update(minibatch.get("image"))))
        both = {key: (value + others.get(key)) / 2 for key, value in losses.items() if key.startswith("loss_")}
        return cast("TensorDictBase", losses.update(both))

    def _adapt(self, share: float) -> None:
        """Change the learning rate, after this share of the way that the policy should have gone."""
        if 0.5 <= share <= 2.0:
            return
        for group in self.optimizer.param_groups:
            group["lr"] = min(max(group["lr"] * (1.5 if share < 0.5 else 1 / 1.5), _RATES[0]), _RATES[1])

    def _minibatches(self) -> Iterator[TensorDictBase]:
        # One draw an epoch, and slices of it: drawing each minibatch from the buffer takes eight times as long.
        parts = self.buffer.sample().split(self.minibatch_size)
        return (part for part in parts if len(part) == self.minibatch_size)


def _explained_variance(value: Tensor, target: Tensor) -> float:
    """Share of the variance of returns that the critic foresaw; 0 is no better than a constant."""
    return 1.0 - float((target - value).var() / target.var().clamp(min=torch.finfo(target.dtype).eps))
