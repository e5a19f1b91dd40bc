"""Driving robots with some of their parameters set, and looking for the values at which a policy fails."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from tensordict.nn import TensorDictModuleBase

from physai.envs.make import TransformedRobotEnv
from physai.envs.simulation import EnvConfig
from physai.physics import RandomizationConfig
from physai.stress.axes import Axis
from physai.training.evaluation import evaluate
from physai.training.run import TrainedPolicy
from physai.transforms import DomainRandomization

ENOUGH = 0.95  # a policy works where its success rate is at least this
_HALVINGS = 5

Setting = tuple[Axis, float]
"""An axis, and the value that all robots have there."""


class Count(NamedTuple):
    """How many of so many episodes succeeded, and how many settled."""

    success: int
    settled: int


@dataclass
class Trial:
    """A policy, and robots to try it on: the same goals, starts and draws at every value of every parameter.

    Args:
        policy: The policy of a run.
        episodes: How many, E; there are as many robots.
        seed: Seeds goals, starts, and draws.
    """

    policy: TrainedPolicy
    episodes: int
    seed: int
    _made: tuple[object, TensorDictModuleBase, TransformedRobotEnv] | None = field(default=None, init=False)

    def count(self, settings: Sequence[Setting], randomization: RandomizationConfig) -> Count:
        """Drive robots with these settings, and the rest as the randomization draws it."""
        config = self.policy.config.env
        for axis, value in settings:
            config = axis.change(config, value)
        draws = {axis.name: axis.draw(value) for axis, value in settings if axis.randomizes}
        randomization = randomization.model_copy(update=draws)
        actor, env = self._robots(config, randomization)
        for transform in env.transform:
            if isinstance(transform, DomainRandomization):
                transform.config = randomization
        scale = math.prod(value for axis, value in settings if axis.name == "tolerance")
        task = env.simulation.task
        env.simulation.tolerance = np.array([scale * tolerance.value for tolerance in task.tolerances])
        found = evaluate(actor, env, self.episodes, self.seed)
        return Count(int(found.success.sum()), int(found.settled.sum()))

    def _robots(
        self, config: EnvConfig, randomization: RandomizationConfig
    ) -> tuple[TensorDictModuleBase, TransformedRobotEnv]:
        """Robots of an env; those of the last time, where they do."""
        key = config, sorted(randomization.draws)
        if self._made is None or self._made[0] != key:
            self.close()
            self._made = (key, *self.policy.deploy(self.episodes, self.seed, config, randomization))
        return self._made[1:]

    def breaks(self, axis: Axis, end: float) -> dict[str, float | None]:
        """Bisect between a robot as described and an end of an axis, with nothing else randomized.

        Returns:
            The last value found at which the policy still works, for ``success`` and ``settled``: that of the robot as
            described where it works nowhere, None where it works up to the end, or where there is nothing in between.
        """
        nominal, known = axis.nominal(self.policy.config.env), dict[float, Count]()
        if end == nominal:
            return {"success": None, "settled": None}

        def works(value: float, what: str) -> bool:
            if value not in known:
                known[value] = self.count([(axis, value)], RandomizationConfig.none())
            return bool(getattr(known[value], what) >= ENOUGH * self.episodes)

        return {what: self._bisect(axis, nominal, end, what, works) for what in ("success", "settled")}

    @staticmethod
    def _bisect(axis: Axis, good: float, bad: float, what: str, works: Callable[[float, str], bool]) -> float | None:
        if not works(good, what):
            return good
        if works(bad, what):
            return None
        for _ in range(_HALVINGS):
            middle = axis.between(good, bad)
            if middle in (good, bad):
                break
            good, bad = (middle, bad) if works(middle, what) else (good, middle)
        return good

    def close(self) -> None:
        """Free the robots."""
        if self._made is not None:
            self._made[2].close()
            self._made = None
