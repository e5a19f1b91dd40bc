"""A curriculum: the ranges of the randomization grow while a policy learns."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from physai.training.config import AdrConfig, LinearConfig
from physai.training.trainer import Callback, Trainer
from physai.transforms import Ranges


class Boundaries:
    """What the boundaries of ranges have come to, and whether they move: automatic domain randomization.

    After OpenAI et al., "Solving Rubik's Cube with a Robot Hand", 2019 (arXiv:1910.07113), algorithm 1, with many
    robots at once as in Handa et al., "DeXtreme", 2023 (arXiv:2210.13702): each side of each parameter has a buffer of
    results and moves by itself. A result counts only if its boundary has not moved since the episode began, for
    otherwise it says nothing about where the boundary is now.

    Args:
        config: When to move, and by how much.
        sides: How many boundaries, S.

    Attributes:
        results: How many are in the buffer of each boundary, [S].
        successes: How many of these are successes, [S].
    """

    def __init__(self, config: AdrConfig, sides: int) -> None:
        self.config = config
        self.results, self.successes = torch.zeros(2, sides, dtype=torch.int64)

    def take(self, side: Tensor, success: Tensor) -> None:
        """Put results into the buffers: sides [E], S for none, and whether each episode was a success [E]."""
        sides = len(self.results)
        self.results = self.results + torch.bincount(side, minlength=sides + 1)[:sides]
        self.successes = self.successes + torch.bincount(side[success], minlength=sides + 1)[:sides]

    def moved(self, share: Tensor) -> Tensor:
        """Return the share [S] of its way that each side now has; empty the buffers that have decided that."""
        config, full = self.config, self.results >= self.config.results
        rate = self.successes / self.results.clamp(min=1)
        step = (rate > config.widen_above).double() - (rate < config.narrow_below).double()
        self.results, self.successes = (torch.where(full, 0, each) for each in (self.results, self.successes))
        return torch.where(full, share + config.step * step, share).clamp(0.0, 1.0)


class CurriculumCallback(Callback):
    """Moves the ranges of the randomization after a batch; every worker draws from them from its next batch on.

    It logs ``curriculum/<parameter>/low`` and ``high``, in the unit of the randomization.

    Args:
        config: How they grow.
        ranges: Those of the learner's env.
    """

    name = "curriculum"

    def __init__(self, config: AdrConfig | LinearConfig, ranges: Ranges) -> None:
        self._ranges = ranges
        self._boundaries = Boundaries(config, len(ranges.sides)) if isinstance(config, AdrConfig) else None

    def begin(self, trainer: Trainer) -> None:
        """See :class:`Callback`."""
        for name in self._ranges.fixed:
            print(f"curriculum: randomization.{name} does not grow: it is not uniform, or has no effect")

    def after_batch(self, trainer: Trainer, batch: TensorDictBase, values: dict[str, float]) -> None:
        """Move the ranges, by the episodes that ended in the batch, or as far as the run is."""
        ranges = self._ranges
        if self._boundaries is None:
            ranges.move(torch.full_like(ranges.share, trainer.clock.frames / trainer.total_frames))
        else:
            after = batch.get("next")
            ended = after.get("done")[..., 0]
            side = ranges.on_boundary(after.get("boundary")[ended][:, 0])
            self._boundaries.take(side, after.get("success")[ended][:, 0])
            ranges.move(self._boundaries.moved(ranges.share))
        for name, ends in ranges.ends.items():
            values |= {f"curriculum/{name}/{end}": value for end, value in ends.items()}

    def state(self) -> dict[str, Any]:
        """See :class:`Callback`."""
        buffers = [] if self._boundaries is None else [self._boundaries.results, self._boundaries.successes]
        return {"ranges": dict(self._ranges.state_dict()), "buffers": buffers}

    def set_state(self, state: dict[str, Any]) -> None:
        """See :class:`Callback`."""
        self._ranges.load_state_dict(state["ranges"])
        if self._boundaries is not None:
            self._boundaries.results, self._boundaries.successes = state["buffers"]
