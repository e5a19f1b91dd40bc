"""A whole stress test: the cells of a map and the break values, on all cores."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from physai import processes
from physai.stress.axes import Axis
from physai.stress.trial import Count, Setting, Trial
from physai.training.evaluation import wilson
from physai.training.run import TrainedPolicy

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
        axes = (self.x, self.x_values, self.trained[0]), (self.y, self.y_values, self.trained[1])
        described = [
            {"name": axis.name, "operation": axis.operation, "values": values.tolist(), "trained": list(trained)}
            for axis, values, trained in axes
        ]
        intervals = {
            what: [[wilson(torch.arange(self.episodes) < count) for count in row] for row in getattr(self, what)]
            for what in ("success", "settled")
        }
        return {
            "x": described[0],
            "y": described[1],
            "episodes": self.episodes,
            **{what: {"count": getattr(self, what).tolist(), "ci": ci} for what, ci in intervals.items()},
        }


class StressTest:
    """Tries a policy in processes of its own, one a core; a context.

    Args:
        policy: The policy of a run.
        episodes: Of each cell, and of each value that is tried for a break.
        seed: Seeds goals, starts, and draws, the same for every value.
    """

    def __init__(self, policy: TrainedPolicy, episodes: int, seed: int) -> None:
        self._policy, self._episodes = policy, episodes
        worker = (os.getpid(), policy, episodes, seed)
        context = multiprocessing.get_context("fork")
        self._pool = ProcessPoolExecutor(len(os.sched_getaffinity(0)), context, _begin, worker)

    def __enter__(self) -> "StressTest":
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def map(self, x: Axis, y: Axis, grid: int, advance: Callable[[], object] = lambda: None) -> Map:
        """Try a grid of values; ``advance`` is called for each cell that is done."""
        x_values, y_values = x.values(grid), y.values(grid)
        cells = {
            self._pool.submit(_count, [(x, float(x_value)), (y, float(y_value))]): (row, column)
            for row, y_value in enumerate(y_values)
            for column, x_value in enumerate(x_values)
        }
        success, settled = np.zeros((2, len(y_values), len(x_values)), int)
        for future in as_completed(cells):
            found, cell = future.result(), cells[future]
            success[cell], settled[cell] = found.success, found.settled
            advance()
        config, randomization = self._policy.config.env, self._policy.config.randomization
        trained = x.trained(randomization, config), y.trained(randomization, config)
        return Map(x, y, x_values, y_values, success, settled, self._episodes, trained)

    def breaks(self, axes: Sequence[Axis]) -> Iterator[tuple[Axis, int, dict[str, float | None]]]:
        """Look for the break values of each axis alone; yield axis, end (0 is low, 1 is high) and what was found."""
        config = self._policy.config.env
        tasks: dict[Future[dict[str, float | None]], tuple[Axis, int]] = {}
        for axis in axes:
            for number, end in enumerate((axis.low, axis.high)):
                if end != axis.nominal(config):
                    tasks[self._pool.submit(_breaks, axis, end)] = axis, number
        for future in as_completed(tasks):
            yield *tasks[future], future.result()


def _begin(parent: int, policy: TrainedPolicy, episodes: int, seed: int) -> None:
    global _trial
    processes.follow(parent)
    torch.set_num_threads(1)
    _trial = Trial(policy, episodes, seed)


def _count(settings: list[Setting]) -> Count:
    assert _trial is not None
    return _trial.count(settings, _trial.policy.randomization)


def _breaks(axis: Axis, end: float) -> dict[str, float | None]:
    assert _trial is not None
    return _trial.breaks(axis, end)
