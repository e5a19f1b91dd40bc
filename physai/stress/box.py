"""The largest box of a randomization in which a policy settles, about the robot as it is described."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch

from physai.physics import ParameterLayout, RandomizationConfig
from physai.robots import RobotSpec
from physai.stress.trial import ENOUGH, Trial
from physai.training.evaluation import wilson
from physai.transforms import Ranges

_HALVINGS = 8


@dataclass(frozen=True)
class Box:
    """All ranges of a randomization, each grown by the same share of its way from the robot as it is described.

    Attributes:
        randomization: Whose ranges these are; a box of share 1 is all of them.
        share: The largest with which at least 95 % of the robots drawn from the box settle; 0 if there is none.
        settled: How many robots did at this share.
        robots: Of so many.
        parameters: How many ranges grow; what is drawn otherwise is drawn as in the randomization.
    """

    randomization: str
    share: float
    settled: int
    robots: int
    parameters: int

    @property
    def volume(self) -> float:
        """Of the whole ranges' volume, where each is measured as it is drawn, evenly or by its logarithm."""
        return self.share**self.parameters

    def summary(self) -> dict[str, Any]:
        """The box for a file."""
        interval = wilson(torch.arange(self.robots) < self.settled)
        return {**asdict(self), "settled_ci": list(interval), "volume": self.volume}


def find_box(trial: Trial, randomization: RandomizationConfig) -> Box:
    """Bisect the share, with the same goals, starts and draws at each.

    It expects that a policy that fails in a box fails in a larger one, too.
    """
    env = trial.policy.config.env
    ranges = Ranges(randomization, ParameterLayout(RobotSpec.from_config(env.robot), env.ignored))

    def settled(share: float) -> int:
        ranges.move(torch.full_like(ranges.share, share))
        return trial.count([], ranges.present).settled

    share, count = bisect(settled, ENOUGH * trial.episodes)
    return Box(randomization.name, share, count, trial.episodes, len(ranges.ends))


def bisect(count: Callable[[float], int], enough: float) -> tuple[float, int]:
    """The largest share from 0 to 1 whose count is enough, and the count; both are those of 0 where none is."""
    good, bad, at_good = 0.0, 1.0, count(0.0)
    if at_good < enough:
        return good, at_good
    if (at_bad := count(bad)) >= enough:
        return bad, at_bad
    for _ in range(_HALVINGS):
        middle = (good + bad) / 2
        found = count(middle)
        if found >= enough:
            good, at_good = middle, found
        else:
            bad = middle
    return good, at_good
