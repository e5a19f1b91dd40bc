"""Ranges of a randomization that grow while a policy learns, and robots that are put on their boundaries."""

import math

import torch
from torch import Tensor, nn

from physai.physics import ParameterLayout, RandomizationConfig
from physai.physics.randomization import Draw, LogUniform, Uniform

_ENDS = ("low", "high")


class Ranges(nn.Module):
    """From where to where the parameters of a randomization are drawn at present.

    A range begins as the single value of the robot as it is described (the nearest one that the randomization allows).
    Each of its two sides grows by itself, up to the end that the randomization has there. How far it is on that way is
    its *share*, from 0 to 1; the way is measured as the parameter is drawn, evenly or by its logarithm. What is not
    drawn uniformly between two numbers, and what has no effect on the robot, is drawn as it is from the start.

    A boundary is where a side is now. The buffers are what a learner changes, and what its workers get.

    Args:
        config: The whole ranges.
        layout: Columns of ``physics_parameters`` and the robot's nominal values.

    Attributes:
        config: The whole ranges.
        fixed: Parameters that are drawn as they are.
        sides: Parameter, and ``low`` or ``high``, of each side that has some way to go, S of them.
        share: How far each side is on its way, float64 [S].
        moves: How often each side has moved, [S].
    """

    def __init__(self, config: RandomizationConfig, layout: ParameterLayout) -> None:
        super().__init__()
        self.config = config = config.of(layout)
        still = config.without_effect(layout)
        self.fixed = [name for name, draw in config.draws.items() if not _grows(draw) or name in still]
        self._starts = {
            name: _nearest(draw, layout.nominal[layout.columns[name]])
            for name, draw in config.draws.items()
            if name not in self.fixed
        }
        self.sides = [
            (name, end)
            for name, start in self._starts.items()
            for end in _ENDS
            if getattr(config.draws[name], end) != start
        ]
        self._pinned_columns = torch.zeros(len(self.sides), len(layout.nominal), dtype=torch.bool)
        for side, (name, _) in enumerate(self.sides):
            self._pinned_columns[side, layout.columns[name]] = True
        self._at_end = torch.tensor([float(end == "high") for _, end in self.sides])
        self.share: Tensor
        self.moves: Tensor
        self.register_buffer("share", torch.zeros(len(self.sides), dtype=torch.float64))
        self.register_buffer("moves", torch.zeros(len(self.sides), dtype=torch.int64))
        self._made: tuple[list[float], RandomizationConfig] | None = None

    def move(self, share: Tensor) -> None:
        """Put each side at a share [S] of its way; in place, for collectors refer to the buffers."""
        share = share.clamp(0.0, 1.0)
        self.moves += share != self.share
        self.share.copy_(share)

    @property
    def ends(self) -> dict[str, dict[str, float]]:
        """``low`` and ``high`` of each parameter that grows, now; in the unit of its draw."""
        ends = {name: dict.fromkeys(_ENDS, start) for name, start in self._starts.items()}
        for (name, end), share in zip(self.sides, self.share.tolist(), strict=True):
            draw = self.config.draws[name]
            ends[name][end] = _between(draw, self._starts[name], getattr(draw, end), share)
        return ends

    @property
    def present(self) -> RandomizationConfig:
        """The randomization with the ranges of now."""
        shares = self.share.tolist()
        if self._made is None or self._made[0] != shares:
            draws = {name: self.config.draws[name].model_copy(update=ends) for name, ends in self.ends.items()}
            self._made = shares, self.config.model_copy(update=draws)
        return self._made[1]

    def pin(self, draws: Tensor, share: float, generator: torch.Generator) -> Tensor:
        """Put a share of robots on a boundary each, any with the same chance.

        Args:
            draws: Uniform numbers in [0, 1), [r, P], for :meth:`RandomizationConfig.apply`; changed in place.
            share: How many robots, of all.
            generator: Chooses robots and boundaries.

        Returns:
            Which boundary, [r]: the number of a side plus S for each move that it had made, plus 1; 0 for none.
        """
        chance, which = torch.rand(2, len(draws), generator=generator)
        side = (which * len(self.sides)).long().clamp(max=len(self.sides) - 1)  # a product may be rounded up
        pinned = chance < share
        columns = self._pinned_columns[side] & pinned[:, None]
        draws.copy_(torch.where(columns, self._at_end[side, None], draws))
        return torch.where(pinned, 1 + side + len(self.sides) * self.moves[side], 0)

    def on_boundary(self, boundary: Tensor) -> Tensor:
        """Say on which side robots stand, [r], from what ``pin`` returned.

        It is S for those on none: no boundary, or one that has moved since.
        """
        sides = len(self.sides)
        side = (boundary - 1) % sides
        still = (boundary > 0) & ((boundary - 1) // sides == self.moves[side])
        return torch.where(still, side, sides)


def _grows(draw: Draw) -> bool:
    """Whether the range of a draw can grow: it is uniform, by itself or by its logarithm, between two numbers."""
    if not isinstance(draw, Uniform | LogUniform):
        return False
    return isinstance(draw.low, float | int) and isinstance(draw.high, float | int) and draw.low < draw.high


def _nearest(draw: Draw, nominal: Tensor) -> float:
    """The value of a draw that changes a robot as little as it can."""
    assert isinstance(draw, Uniform | LogUniform)
    low, high = draw.low, draw.high
    assert isinstance(low, float | int)
    assert isinstance(high, float | int)
    value = {"scale": 1.0, "add": 0.0, "set": float(nominal.double().mean())}[draw.operation]
    return min(max(value, low), high)


def _between(draw: Draw, start: float, end: float, share: float) -> float:
    if share in (0.0, 1.0):
        return end if share else start  # with no rounding
    if isinstance(draw, LogUniform):
        return start * math.exp(share * math.log(end / start))
    return start + share * (end - start)
