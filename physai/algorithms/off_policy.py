"""Off-policy learning: frames go into a replay buffer, and minibatches of all that it holds are learned from."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers import PrioritizedSampler
from torchrl.objectives import TargetNetUpdater
from torchrl.objectives.utils import ValueEstimators

from physai.algorithms.descent import Descent, check_ranges
from physai.algorithms.interface import Networks
from physai.config import Count, NonNegativeFloat, PositiveFloat
from physai.errors import UserError

_RAW, _NORMALIZED = "observation", "normalized_observation"


class OffPolicy:
    """An off-policy actor-critic algorithm, put together from TorchRL parts (``conf/algo/sac.yaml``).

    It is a :class:`physai.algorithms.Algorithm`. The buffer keeps raw observations: they are normalized when they are
    drawn, with the statistics of then. The factories are what ``_partial_: true`` makes of a config node.

    Args:
        networks: The critic judges actions: it sees ``action``.
        frames_per_batch: Size of the batches to come.
        loss: Makes the loss module from the actor and the critic; all its ``loss_*`` outputs are summed.
        gamma: Discount factor.
        buffer: Replay buffer; its ``batch_size`` is the minibatch of a gradient step.
        optimizer: Makes the optimizer from the parameters.
        scheduler: Makes the learning-rate schedule from the optimizer; it steps once a batch. None keeps the rate.
        target: Makes what lets the target networks follow, from the loss module.
        warmup_frames: So many frames are collected with random actions before anything is learned.
        frames_per_update: A gradient step for each so many frames.
        actor_every: The actor learns in every so-manieth gradient step (2 in TD3).
        max_grad_norm: Gradients are clipped to this norm.
    """

    def __init__(
        self,
        networks: Networks,
        frames_per_batch: int,
        loss: Callable[..., Any],
        gamma: NonNegativeFloat,
        buffer: TensorDictReplayBuffer,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None,
        target: Callable[..., TargetNetUpdater],
        warmup_frames: Count,
        frames_per_update: Count,
        actor_every: Count,
        max_grad_norm: PositiveFloat,
    ) -> None:
        if "state_action_value" not in networks.critic.out_keys:
            raise UserError("policy.critic.in_keys: this algorithm's critic judges actions: it must see 'action'")
        if frames_per_batch % frames_per_update:
            raise UserError(
                f"algo.frames_per_update ({frames_per_update}) must divide "
                f"collector.frames_per_batch ({frames_per_batch})"
            )
        if buffer.batch_size is None or buffer.storage.max_size < max(frames_per_batch, buffer.batch_size):
            raise UserError(
                f"algo.buffer.storage.max_size: {buffer.storage.max_size} frames are fewer than a batch "
                f"({frames_per_batch}) or a minibatch ({buffer.batch_size})"
            )
        self.loss = loss(networks.actor, networks.critic)
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        check_ranges("algo", self.loss.value_estimator)
        self._target = target(self.loss)
        self.descent = Descent(self.loss, optimizer, scheduler, max_grad_norm)
        self.warmup_frames = warmup_frames
        self.buffer = buffer
        self._generator = torch.Generator()
        self._generator.manual_seed(int(torch.randint(2**62, ())))
        buffer.set_rng(self._generator)
        self._seen = 0  # frames
        self._updates = frames_per_batch // frames_per_update
        self._actor_every = actor_every
        self._normalizer = networks.normalizer
        stored = {tuple(_RAW if part == _NORMALIZED else part for part in _path(key)) for key in self.loss.in_keys}
        self._keys = [*sorted(stored | {("action",), (_RAW,), ("next", _RAW)} - {("priority_weight",)})]

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Remember a batch of frames [N, T] and learn from all that is remembered; return means over the steps.

        Until the warm-up is over the losses are computed, and not followed.

        Raises:
            NonFiniteError: If a loss or gradient is not finite; the step is not taken.
        """
        self.buffer.extend(batch.select(*self._keys, strict=False).reshape(-1))
        self._seen += batch.numel()
        learning = self._seen > self.warmup_frames
        updates, size = (self._updates if learning else 1), self.buffer.batch_size
        # One draw for all steps, and slices of it: drawing each minibatch by itself takes longer than learning from it.
        drawn = self.buffer.sample(updates * size)
        for frames in (drawn, drawn.get("next")):
            frames.set(_NORMALIZED, self._normalizer(frames.get(_RAW)))
        results, priorities = [], []
        for step in range(updates):
            minibatch = drawn[step * size : (step + 1) * size]
            losses = self.loss(minibatch)
            figures = losses.select(*(key for key in losses.keys() if losses.get(key).ndim == 0)).detach()
            if learning:
                leave_out = "loss_actor" if (step + 1) % self._actor_every else ""
                figures.set("grad_norm", self.descent.step(losses, minibatch, leave_out))
                self._target.step()
            else:
                figures.set("grad_norm", torch.zeros(()))
            results.append(figures)
            priorities.append(minibatch.get("td_error").detach())
        if isinstance(self.buffer.sampler, PrioritizedSampler):
            self.buffer.update_priority(drawn.get("index"), torch.cat(priorities))
        means: TensorDictBase = torch.stack(results).mean(dim=0)
        return {key: float(value) for key, value in means.items()} | {"lr": self.descent.end_batch()}

    def weights(self) -> dict[str, Tensor]:
        """All weights by name, target networks included."""
        return self.descent.weights()

    def state(self) -> dict[str, Any]:
        """Return what ``set_state`` needs to go on bit for bit: all frames in the buffer, too."""
        held, sampler = len(self.buffer), self.buffer.sampler
        frames = self.buffer.storage.get(range(held)) if held else TensorDict({}, [0])
        priorities = None
        if held and isinstance(sampler, PrioritizedSampler):
            priorities = torch.as_tensor(sampler._sum_tree[torch.arange(held)]), sampler._max_priority
        return {
            **self.descent.state(),
            "frames": {".".join(key): frames.get(key).clone() for key in self._keys} if held else {},
            "cursor": self.buffer.writer._cursor,
            "seen": self._seen,
            "priorities": priorities,
            "generator": self._generator.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned."""
        self.descent.set_state(state)
        self.buffer.empty()
        if state["frames"]:
            held = TensorDict({}, [len(next(iter(state["frames"].values())))])
            for name, values in state["frames"].items():
                held.set(tuple(name.split(".")), values)
            self.buffer.extend(held)
        self.buffer.writer._cursor = state["cursor"]
        if state["priorities"] is not None:
            sampler = self.buffer.sampler
            leaves, sampler._max_priority = state["priorities"]
            sampler._sum_tree[torch.arange(len(leaves))] = leaves
            sampler._min_tree[torch.arange(len(leaves))] = leaves
        self._seen = state["seen"]
        self._generator.set_state(state["generator"])


def _path(key: str | tuple[str, ...]) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else tuple(key)

