"""Policies trained for a robot as its recording shows it, against those trained for any: on the robot itself."""

import tempfile
from argparse import Namespace
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np
from rich.table import Table
from scipy import stats

from physai.bench.hidden import Hidden, record
from physai.bench.identify import ENGINE, SECONDS, UNKNOWNS, identify
from physai.bench.timing import config_of, table
from physai.identify.randomization import identified
from physai.training.config import TrainConfig
from physai.training.run import TrainedPolicy, run_training

ROBOTS = 20
EPISODES = 500
DEFAULTS = 5  # policies that are trained once, each for several robots


@dataclass(frozen=True)
class Judged:
    """A policy on a robot.

    Attributes:
        steps: To the goal, a mean; a goal that is missed counts as all the steps of an episode.
        settled: Share of the goals.
    """

    steps: float
    settled: float


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return identified_table(measure_identified(options.seed))


def measure_identified(
    seed: int, robots: int = ROBOTS, episodes: int = EPISODES, seconds: float = SECONDS, overrides: tuple[str, ...] = ()
) -> list[tuple[Judged, Judged]]:
    """Draw robots from ``randomization=strong``; train with ``default`` and with what is found of each, and judge both.

    Returns:
        A pair for each robot: ``default``, then what was found.
    """
    strong = config_of("reacher", seed, ENGINE, "randomization=strong")
    pairs = []
    with tempfile.TemporaryDirectory() as folder:
        runs = Path(folder)
        for number in range(robots):
            hidden = record(strong.env, strong.randomization, UNKNOWNS, seconds, seed + number)
            config = config_of("reacher", seed + number % DEFAULTS, ENGINE, "export.formats=[]", *overrides)
            found = identify(hidden, config.env, UNKNOWNS).fit
            own = identified(found, hidden.layout, config.randomization)
            general = _train(config, runs / f"default{number % DEFAULTS}")
            narrow = _train(config.model_copy(update={"randomization": own}), runs / f"identified{number}")
            pairs.append((_judge(general, hidden, episodes), _judge(narrow, hidden, episodes)))
            first, second = pairs[-1]
            print(
                f"robot {number}: {first.steps:.1f} and {second.steps:.1f} steps, settled {first.settled:.1%} and "
                f"{second.settled:.1%}",
                flush=True,
            )
    return pairs


def _train(config: TrainConfig, folder: Path) -> TrainedPolicy:
    if not folder.is_dir():
        folder.mkdir()
        with redirect_stdout(StringIO()):
            run_training(config, folder)
    return TrainedPolicy(folder, "best", config=config)


def _judge(policy: TrainedPolicy, hidden: Hidden, episodes: int) -> Judged:
    policy.randomization = hidden.itself()
    result = policy.evaluate(episodes)
    return Judged(float(result.length.double().mean()), result.settled_rate)


def identified_table(pairs: list[tuple[Judged, Judged]]) -> Table:
    """Show means, and the mean difference with its 95 % interval (Student's t over robots)."""
    shown = table(f"{len(pairs)} hidden robots, policies trained for", "", "default", "identified", "difference")
    rows = {
        "steps to goal": [[judged.steps for judged in pair] for pair in pairs],
        "settled, %": [[100 * judged.settled for judged in pair] for pair in pairs],
    }
    for what, values in rows.items():
        sides = np.array(values)
        differences = sides[:, 1] - sides[:, 0]
        low, high = stats.ttest_1samp(differences, 0.0).confidence_interval()
        first, second = sides.mean(axis=0)
        shown.add_row(what, f"{first:.1f}", f"{second:.1f}", f"{differences.mean():+.1f} ({low:+.1f} to {high:+.1f})")
    return shown
