"""``python -m physai.search``: look for better values for training (see ``--help``)."""

import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from physai import cli
from physai.compose import compose, parse
from physai.config import validate
from physai.errors import UserError

if TYPE_CHECKING:
    from physai.search.config import SearchConfig


def main() -> None:
    """Begin a search, or go on with one."""
    with cli.guard():
        if not {"-m", "--multirun"}.isdisjoint(sys.argv):
            raise UserError("a search takes ranges as they are, without -m")
        search = Search(cli.overrides())
    cli.main("search", search.run, search.check, search.common)


def _config(node: DictConfig) -> "SearchConfig":
    from physai.search.config import SearchConfig

    return validate(SearchConfig, node)


class Search:
    """The command.

    Args:
        given: Its overrides, with and without ranges.
    """

    def __init__(self, given: list[str]) -> None:
        self._given = given
        parsed = [one for one in parse(given) if not one.is_sweep_override()]
        self.common = [str(one.input_line) for one in parsed]
        own = ("hydra", "search")  # what is not for the trials
        self._fixed = [str(one.input_line) for one in parsed if re.split("[./]", one.key_or_group)[0] not in own]

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
        from physai.search.loop import run_trials
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
            with Report(folder, study, settings.trials) as report:
                run_trials(folder, study, config, self._fixed, report.ended)
            report.summary(self._fixed)
        except KeyboardInterrupt:
            print(f"\nInterrupted; go on with the same command and hydra.run.dir={folder}")
            raise
        finally:
            study.close()


if __name__ == "__main__":
    main()
