"""A whole stress test: the cells of a map and the break values, on all cores."""

import multiprocessing
import os
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from rich.progress import track

from physai import processes
from physai.stress.axes import Axis
from physai.stress.box import Box, find_box
from physai.stress.trial import Count, Setting, Trial
from physai.training.evaluation import wilson
from physai.training.run import TrainedPolicy

Breaks = dict[str, dict[str, list[float | None]]]
"""By axis, for ``success`` and ``settled``: the last values that work, towards the low and the high end."""

_trial: Trial | None = None  # of a worker


@dataclass(frozen=True)
class Map:
    """Success and settled over two axes.

    Attributes:
        x: From left to right.
        y: From bottom to top.
        x_values: [X].
        y_values: [Y].
        success: How many episodes of a cell succeeded, [Y, X].
        settled: How many settled, [Y, X].
        episodes: In each cell.
        trained: From where to where x, and y, went in training.
    """

    x: Axis
    y: Axis
    x_values: np.ndarray
    y_values: np.ndarray
    success: np.ndarray
    settled: np.ndarray
    episodes: int
    trained: tuple[tuple[float, float], tuple[float, float]]

    def summary(self) -> dict[str, Any]:
        """The map for a file: counts, and 95 % intervals of the rates."""
        axes = {"x": (self.x, self.x_values, self.trained[0]), "y": (self.y, self.y_values, self.trained[1])}
        described = {
            key: {"name": axis.name, "operation": axis.operation, "values": values.tolist(), "trained": list(trained)}
            for key, (axis, values, trained) in axes.items()
        }
        intervals = {
            what: [[wilson(torch.arange(self.episodes) < count) for count in row] for row in getattr(self, what)]
            for what in ("success", "settled")
        }
        return {
            **described,
            "episodes": self.episodes,
            **{what: {"count": getattr(self, what).tolist(), "ci": ci} for what, ci in intervals.items()},
        }


class StressTest:
    """Tries a policy in processes of its own, one a core; a context.

    Args:
        policy: The policy of a run.
        episodes: Of each cell, and of each value that is tried for a break.
        seed: Seeds goals, starts, and draws, the same for every value.
        name: Of the policy, for those who wait.
    """

    def __init__(self, policy: TrainedPolicy, episodes: int, seed: int, name: str = "") -> None:
        self._policy, self._episodes, self._name = policy, episodes, name
        worker = (os.getpid(), policy, episodes, seed)
        context = multiprocessing.get_context("fork")
        self._pool = ProcessPoolExecutor(len(os.sched_getaffinity(0)), context, _begin, worker)

    def __enter__(self) -> "StressTest":
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def map(self, x: Axis, y: Axis, grid: int) -> Map:
        """Try a grid of values."""
        x_values, y_values = x.values(grid), y.values(grid)
        cells = [[(x, float(x_value)), (y, float(y_value))] for y_value in y_values for x_value in x_values]
        counts = self._shown("map", self._pool.map(_count, cells), len(cells))
        success, settled = np.array(list(counts)).T.reshape(2, len(y_values), -1)
        config, randomization = self._policy.config.env, self._policy.config.randomization
        trained = x.trained(randomization, config), y.trained(randomization, config)
        return Map(x, y, x_values, y_values, success, settled, self._episodes, trained)

    def breaks(self, axes: Sequence[Axis]) -> Breaks:
        """Look for the break values of each axis alone."""
        tasks = [(axis, end) for axis in axes for end in (axis.low, axis.high)]
        found = list(self._shown("break values", self._pool.map(_breaks, *zip(*tasks, strict=True)), len(tasks)))
        return {
            axis.name: {what: [low[what], high[what]] for what in low}
            for axis, low, high in zip(axes, found[::2], found[1::2], strict=True)
        }

    def box(self) -> Box:
        """Look for the largest box in which the policy settles."""
        return self._pool.submit(_box).result()

    def _shown(self, what: str, results: Iterable[Any], total: int) -> Iterable[Any]:
        """The results as they come, with a bar on a terminal."""
        return track(results, f"{self._name}: {what}", total, disable=not sys.stdout.isatty())


def _begin(parent: int, policy: TrainedPolicy, episodes: int, seed: int) -> None:
    global _trial
    processes.follow(parent)
    torch.set_num_threads(1)
    _trial = Trial(policy, episodes, seed)


def _count(settings: list[Setting]) -> Count:
    assert _trial is not None
    return _trial.count(settings, _trial.policy.randomization)


def _box() -> Box:
    assert _trial is not None
    return find_box(_trial, _trial.policy.randomization)


def _breaks(axis: Axis, end: float) -> dict[str, float | None]:
    assert _trial is not None
    return _trial.breaks(axis, end)
