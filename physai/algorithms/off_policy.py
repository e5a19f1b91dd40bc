"""Off-policy learning: frames go into a replay buffer, and minibatches of all that it holds are learned from."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler
from torchrl.objectives import DDPGLoss, TargetNetUpdater, TD3Loss
from torchrl.objectives.utils import ValueEstimators

from physai.algorithms.gradient import GradientAlgorithm, check_ranges
from physai.algorithms.interface import Networks
from physai.algorithms.proportional import ProportionalSampler
from physai.config import Count, NonNegativeFloat, PositiveFloat
from physai.errors import UserError

_RAW, _NORMALIZED = "observation", "normalized_observation"
_MADE_LATER = {("priority_weight",), ("next", "action")}  # by the buffer and by the loss


class OffPolicy(GradientAlgorithm):
    """An off-policy actor-critic algorithm, put together from TorchRL parts (``conf/algo/sac.yaml``).

    It is a :class:`physai.algorithms.Algorithm`. The buffer keeps raw observations: they are normalized when they are
    drawn, with the statistics of then. The factories are what ``_partial_: true`` makes of a config node.

    Args:
        networks: The critic judges actions: it sees ``action``.
        frames_per_batch: Size of the batches to come.
        loss: Makes the loss module from the actor and the critic; all its ``loss_*`` outputs are summed.
        gamma: Discount factor.
        buffer: Replay buffer on LazyTensorStorage or LazyMemmapStorage, with RandomSampler or ProportionalSampler.
        minibatch_size: Samples of a gradient step.
        optimizer: Makes the optimizer from the parameters.
        scheduler: Makes the learning-rate schedule from the optimizer; it steps once a batch. None keeps the rate.
        target: Makes what lets the target networks follow, from the loss module.
        warmup_frames: So many frames are collected with random actions before anything is learned.
        frames_per_update: A gradient step for each so many frames.
        actor_every: The actor learns in every so-manieth gradient step (2 in TD3); targets follow in each.
        max_grad_norm: Gradients are clipped to this norm.
    """

    def __init__(
        self,
        networks: Networks,
        frames_per_batch: int,
        loss: Callable[..., Any],
        gamma: NonNegativeFloat,
        buffer: TensorDictReplayBuffer,
        minibatch_size: Count,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None,
        target: Callable[..., TargetNetUpdater],
        warmup_frames: Count,
        frames_per_update: Count,
        actor_every: Count,
        max_grad_norm: PositiveFloat,
    ) -> None:
        if getattr(networks.actor, "memory_size", 0):
            raise UserError("policy.actor: this algorithm learns from single frames: the actor must not remember any")
        if "state_action_value" not in networks.critic.out_keys:
            raise UserError("policy.critic.in_keys: this algorithm's critic judges actions: it must see 'action'")
        if frames_per_batch % frames_per_update:
            raise UserError(
                f"algo.frames_per_update ({frames_per_update}) must divide "
                f"collector.frames_per_batch ({frames_per_batch})"
            )
        _check_buffer(buffer, frames_per_batch)
        try:
            made = loss(networks.actor, networks.critic)
        except ValueError as error:
            raise UserError(f"algo.loss: {error}") from error
        except (AttributeError, IndexError) as error:  # no get_dist, or no log_prob_keys
            name = type(networks.actor).__name__
            raise UserError(f"policy.actor: this loss draws from a distribution, and {name} has none") from error
        if (drawn := getattr(made.tensor_keys, "action", "action")) != "action":
            raise UserError(f"policy.actor: this loss would learn from '{drawn}', and the critic judges 'action'")
        judged = {_path(key) for key in networks.critic.in_keys}
        if isinstance(made, TD3Loss) and (unseen := judged - {("action",), *map(_path, networks.actor.in_keys)}):
            raise UserError(f"policy.critic.in_keys: in TD3Loss it sees what the actor sees, not '{min(unseen)[0]}'")
        made.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        check_ranges("algo", made.value_estimator)
        super().__init__(made, optimizer, scheduler, max_grad_norm)
        self._squared = isinstance(self.loss, TD3Loss | DDPGLoss)  # so is the error that these report
        self._target = target(self.loss)
        self.warmup_frames = warmup_frames
        self.buffer = buffer
        self.minibatch_size = minibatch_size
        self._generator = torch.Generator()
        self._generator.manual_seed(int(torch.randint(2**62, ())))
        buffer.set_rng(self._generator)
        self._seen = 0  # frames
        self._steps = 0
        self._updates = frames_per_batch // frames_per_update
        self._actor_every = actor_every
        self._normalizer, self._device = networks.normalizer, networks.device
        needed = {_path(key) for key in self.loss.in_keys} | judged | {("next", *key) for key in judged}
        stored = {tuple(_RAW if part == _NORMALIZED else part for part in path) for path in needed}
        self._keys = sorted((stored | {("action",), (_RAW,), ("next", _RAW)}) - _MADE_LATER)

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Remember a batch of frames [N, T] and learn from all that is remembered; return means over the steps.

        Until the warm-up is over the losses are computed, and not followed.

        Raises:
            NonFiniteError: If a loss or gradient is not finite; the step is not taken.
        """
        self.buffer.extend(batch.select(*self._keys, strict=False).reshape(-1))
        self._seen += batch.numel()
        learning = self._seen > self.warmup_frames
        updates, size = (self._updates if learning else 1), self.minibatch_size
        # One draw for all steps, and slices of it: drawing each minibatch by itself takes longer than learning from it.
        drawn = self.buffer.sample(updates * size)
        for frames in (drawn, drawn.get("next")):
            frames.set(_NORMALIZED, self._normalizer(frames.get(_RAW)))
        drawn = drawn.to(self._device)
        results, priorities = [], []
        for step in range(updates):
            minibatch = drawn[step * size : (step + 1) * size]
            losses = self.loss(minibatch)
            figures = losses.select(*(key for key, value in losses.items() if value.ndim == 0)).detach()
            if learning:
                self._steps += 1
                leave_out = "loss_actor" if self._steps % self._actor_every else ""
                figures.set("grad_norm", self.step(losses, minibatch, leave_out))
                self._target.step()
            else:
                figures.set("grad_norm", torch.zeros(()))
            results.append(figures)
            priorities.append(minibatch.get("td_error").detach())
        if isinstance(self.buffer.sampler, ProportionalSampler):
            errors = torch.cat(priorities)
            self.buffer.update_priority(drawn.get("index"), errors.sqrt() if self._squared else errors)
        means: TensorDictBase = torch.stack(results).mean(dim=0)
        return {key: float(value) for key, value in means.items()} | {"lr": self.end_batch()}

    def state(self) -> dict[str, Any]:
        """Return what ``set_state`` needs to go on bit for bit: all frames in the buffer, too."""
        held = len(self.buffer)
        frames: Any = self.buffer.storage.get(range(held)) if held else None
        return {
            **super().state(),
            "frames": {".".join(key): frames.get(key).clone() for key in self._keys} if held else {},
            "writer": self.buffer.writer.state_dict(),
            "seen": self._seen,
            "steps": self._steps,
            "sampler": self.buffer.sampler.state_dict(),
            "generator": self._generator.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned."""
        super().set_state(state)
        self.buffer.empty()
        if state["frames"]:
            self.buffer.extend(TensorDict(state["frames"]).auto_batch_size_(1).unflatten_keys("."))
        self.buffer.writer.load_state_dict(state["writer"])
        self.buffer.sampler.load_state_dict(state["sampler"])
        self._seen, self._steps = state["seen"], state["steps"]
        self._generator.set_state(state["generator"])


def _check_buffer(buffer: TensorDictReplayBuffer, frames_per_batch: int) -> None:
    storage, sampler = buffer.storage, buffer.sampler
    if not isinstance(storage, LazyTensorStorage) or type(sampler) not in (RandomSampler, ProportionalSampler):
        raise UserError(
            "algo.buffer: storage must be a LazyTensorStorage or LazyMemmapStorage, and sampler a RandomSampler or "
            f"ProportionalSampler, got {type(storage).__name__} and {type(sampler).__name__}"
        )
    if buffer.batch_size is not None:
        raise UserError("algo.buffer.batch_size: leave it out; minibatches are algo.minibatch_size")
    if storage.max_size < frames_per_batch:
        raise UserError(
            f"algo.buffer.storage.max_size: a batch, collector.frames_per_batch={frames_per_batch}, "
            f"does not fit into {storage.max_size}"
        )


def _path(key: str | tuple[str, ...]) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else tuple(key)
