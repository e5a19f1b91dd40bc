"""``python -m physai.search``: look for better values for training (see ``--help``)."""

import sys
from importlib.util import find_spec
from multiprocessing.connection import wait
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from physai import cli
from physai.compose import compose, parse
from physai.errors import UserError

if TYPE_CHECKING:
    from optuna import Trial

    from physai.search.config import SearchConfig, StudyConfig
    from physai.search.report import Report
    from physai.search.study import Study
    from physai.search.trials import TrialProcess

_POLL = 0.5  # s


def main() -> None:
    """Begin a search, or go on with one."""
    with cli.guard():
        if not {"-m", "--multirun"}.isdisjoint(sys.argv):
            raise UserError("a search takes ranges as they are, without -m")
        search = Search(cli.overrides())
    cli.main("search", search.run, search.check, search.common)


class Search:
    """The command.

    Args:
        given: Its overrides, with and without ranges.
    """

    def __init__(self, given: list[str]) -> None:
        self._given = given
        parsed = [one for one in parse(given) if not one.is_sweep_override()]
        own = ("hydra", "search")
        self.common = [str(one.input_line) for one in parsed]
        self._fixed = [str(one.input_line) for one in parsed if not one.key_or_group.lstrip("+~").startswith(own)]

    def check(self, node: DictConfig) -> None:
        """See that every choice and both ends of every range make a run."""
        if not find_spec("optuna"):
            raise UserError("a search needs Optuna: pip install 'physai[optuna]'")
        from physai.search import space
        from physai.train import Training

        settings = _config(node).search
        ranges = space.ranges(settings.ranges, self._given)
        if not ranges:
            raise UserError("there is nothing to search: give a range, such as algo.optimizer.lr=interval(1e-4,1e-2)")
        training = Training()
        for values in space.samples(space.make_space(ranges)):
            training.check(compose("train", [*self._fixed, *space.overrides(values)]))

    def run(self, node: DictConfig, folder: Path) -> None:
        """Search, and report."""
        from physai.search import space
        from physai.search.report import Report
        from physai.search.study import Study

        config = _config(node)
        settings = config.search
        ranges = space.ranges(settings.ranges, self._given)
        about = {
            "fixed": sorted(one for one in self._fixed if not one.startswith("allow=")),
            "ranges": ranges,
            "objective": settings.objective,
            "target": settings.target,
        }
        study = Study(folder, about, space.make_space(ranges), config.seed, settings.minimize)
        try:
            if done := len(study.done()):
                print(f"{folder}: {done} trials are done, {max(0, settings.trials - done)} are left.", flush=True)
            report = Report(folder, study, settings.trials)
            with report:
                _Trials(folder, study, report, config, self._fixed).run()
            report.summary(self._fixed)
        finally:
            study.close()


class _Trials:
    """Runs the trials that are left, some at a time."""

    def __init__(
        self, folder: Path, study: "Study", report: "Report", config: "SearchConfig", fixed: list[str]
    ) -> None:
        self._folder, self._study, self._report, self._fixed = folder, study, report, fixed
        self._settings: StudyConfig = config.search
        self._every_frames = config.evaluation.every_frames
        self._running: dict[int, tuple[Trial, TrialProcess]] = {}
        self._pruned: set[int] = set()
        self._steps: dict[int, int] = {}

    def run(self) -> None:
        try:
            while self._start() or self._running:
                wait([process.sentinel for _, process in self._running.values()], _POLL)
                for run in list(self._running):
                    self._look(run)
        finally:
            for _, process in self._running.values():
                process.stop()
            for _, process in self._running.values():
                process.join(20)
