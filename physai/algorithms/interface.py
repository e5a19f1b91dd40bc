"""What the training loop knows of an algorithm, and what an algorithm is given."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from physai.transforms.normalization import Normalizer


@dataclass(frozen=True)
class Networks:
    """What learns.

    Attributes:
        actor: The policy; for losses that draw from it, ``dist_sample_keys`` and ``log_prob_keys`` tell what was drawn.
        critic: Judges states, or actions in states.
        normalizer: Makes ``normalized_observation`` of an ``observation``, with the statistics of now; on the CPU.
        mirror: Makes what turns frames into those of a mirror image; raises a UserError where robots have none.
    """

    actor: TensorDictModuleBase
    critic: TensorDictModuleBase
    normalizer: Normalizer
    mirror: Callable[[], Callable[[TensorDictBase], TensorDictBase]]

    @property
    def device(self) -> torch.device:
        """Where actor and critic are, and where learning takes place."""
        return next(self.critic.parameters()).device


class Algorithm(Protocol):
    """Made by ``conf/algo/*.yaml`` from ``networks`` and ``frames_per_batch``.

    Attributes:
        warmup_frames: So many frames are collected with random actions first.
    """

    warmup_frames: int

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch of frames [N, T] on the CPU; return what there is to plot, the same keys every time.

        Raises:
            NonFiniteError: If a loss or gradient is not finite; the step is not taken.
        """

    def state(self) -> dict[str, Any]:
        """Return what ``set_state`` needs to go on bit for bit."""

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned."""

    def weights(self) -> dict[str, Any]:
        """All weights by name, those of the networks and of what the algorithm made of them."""


class NonFiniteError(ArithmeticError):
    """A number is NaN or infinite; ``batch`` is the data that shows it."""

    def __init__(self, what: str, batch: TensorDictBase) -> None:
        super().__init__(what)
        self.batch = batch
