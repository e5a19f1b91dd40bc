"""A student learns to act as its teacher would, in states that it gets into by acting itself."""

import warnings
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from physai.algorithms.gradient import GradientAlgorithm, check_minibatch, sequences
from physai.algorithms.interface import Networks
from physai.config import Count, PositiveFloat
from physai.errors import UserError
from physai.policies import GaussianActor
from physai.transforms.normalization import Normalizer


class Teacher:
    """A trained policy that says what it would do.

    Args:
        actor: It sees single states; it may see what no robot can tell.
        normalizer: Of observations, with the statistics that the actor was trained with.
    """

    def __init__(self, actor: GaussianActor, normalizer: Normalizer) -> None:
        self.actor = actor.requires_grad_(False)
        self.normalizer = normalizer

    @torch.no_grad()
    def __call__(self, frames: TensorDictBase) -> Tensor:
        """Mean actions, [.., n] in (-1, 1), in frames of an env [..]."""
        own = {"normalized_observation": self.normalizer(frames.get("observation"))}
        return self.actor.mean(frames.select(*self.actor.in_keys, strict=False).update(own)).tanh()


class Distill(GradientAlgorithm):
    """The student acts, the teacher says what it would have done there, and the student learns that.

    It is a :class:`physai.algorithms.Algorithm`. After Ross, Gordon and Bagnell, "A Reduction of Imitation Learning and
    Structured Prediction to No-Regret Online Learning" (DAgger), 2011; that a student without the robot's parameters
    finds them out from what it remembers is the second phase of Kumar et al., "RMA: Rapid Motor Adaptation for Legged
    Robots", arXiv 2107.04034. Only the last batch is learned from. Minibatches are whole sequences: gradients of an
    actor that remembers go back to the beginning of the batch, and no further. The critic has nothing to do.

    Args:
        networks: The actor is the student.
        frames_per_batch: Size of the batches to come.
        teacher: In a config, its run folder.
        loss: Makes the loss module from ``actor_network``, which writes the student's mean ``action``; it finds the
            teacher's under the same key. All its ``loss_*`` outputs are summed.
        minibatch_size: Samples of a gradient step: as many sequences as have so many, at least one.
        optimizer: Makes the optimizer from the parameters.
        scheduler: Makes the learning-rate schedule from the optimizer; it steps once a batch.
        epochs: Passes over each batch.
        max_grad_norm: Gradients are clipped to this norm.
    """

    warmup_frames = 0

    def __init__(
        self,
        networks: Networks,
        frames_per_batch: int,
        teacher: Any,
        loss: Callable[..., Any],
        minibatch_size: Count,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None,
        epochs: Count,
        max_grad_norm: PositiveFloat,
    ) -> None:
        check_minibatch(minibatch_size, frames_per_batch)
        if not isinstance(networks.actor, GaussianActor):
            raise UserError(
                f"policy.actor: a student needs a mean to learn, such as that of GaussianActor or GRUActor; "
                f"{type(networks.actor).__name__} has none"
            )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # TorchRL misses target networks, of which there are none
            made = loss(actor_network=MeanAction(networks.actor))
        super().__init__(made, optimizer, scheduler, max_grad_norm)
        self.teacher: Teacher = teacher
        self.minibatch_size = minibatch_size
        self.epochs = epochs
        self._seen = networks.actor.in_keys
        self._device = networks.device

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch of frames [N, T]; return means over all minibatches.

        Raises:
            NonFiniteError: If a loss or gradient is not finite; the step is not taken.
        """
        frames = batch.select(*self._seen).set("action", self.teacher(batch)).to(self._device)
        results: list[TensorDictBase] = []
        for _ in range(self.epochs):
            for minibatch in sequences(frames, self.minibatch_size):
                losses = self.loss(minibatch)
                results.append(losses.set("grad_norm", self.step(losses, minibatch)))
        with torch.no_grad():
            means: TensorDictBase = torch.stack(results).mean(dim=0)
        return {key: float(value) for key, value in means.items()} | {"lr": self.end_batch()}


class MeanAction(TensorDictModuleBase):
    """Writes ``action`` [.., n], the mean one of an actor, for single steps [N] or sequences [M, T].

    Args:
        actor: Whose.
    """

    out_keys = ("action",)

    def __init__(self, actor: GaussianActor) -> None:
        super().__init__()
        self.in_keys = actor.in_keys
        self.actor = actor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act."""
        return tensordict.set("action", self.actor.mean(tensordict).tanh())
