"""``python -m physai.search``: look for better values for training (see ``--help``)."""

import re
import sys
from importlib.util import find_spec
from pathlib import Path

from omegaconf import DictConfig

from physai import cli
from physai.compose import compose, parse
from physai.config import validate
from physai.errors import UserError


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
        self.common = [str(one.input_line) for one in parsed]
        own = ("hydra", "search")  # what is not for the trials
        self._fixed = [str(one.input_line) for one in parsed if re.split("[./]", one.key_or_group)[0] not in own]

    def check(self, node: DictConfig) -> None:
        """See that every choice and both ends of every range make a run."""
        if not find_spec("optuna"):
            raise UserError("a search needs Optuna: pip install 'physai[optuna]'")
        from physai.search import space
        from physai.search.config import SearchConfig
        from physai.train import Training

        self._config = validate(SearchConfig, node)
        self._ranges = space.ranges(self._config.search.ranges, self._given)
        self._space = space.make_space(self._ranges)
        if not self._space:
            raise UserError("there is nothing to search: give a range, such as algo.optimizer.lr=interval(1e-4,1e-2)")
        training = Training()
        for values in space.samples(self._space):
            training.check(compose("train", [*self._fixed, *space.overrides(values)]))

    def run(self, _: DictConfig, folder: Path) -> None:
        """Search, and report."""
        from physai.search.loop import run_trials
        from physai.search.report import Report
        from physai.search.study import Study

        settings = self._config.search
        about = {
            "fixed": sorted(one for one in self._fixed if not one.startswith("allow=")),
            "ranges": self._ranges,
            "objective": settings.objective,
            "target": settings.target,
        }
        study = Study(folder, about, self._space, self._config.seed, settings.minimize)
        try:
            if done := study.done():
                print(f"{folder}: {done} trials are done, {max(0, settings.trials - done)} are left.", flush=True)
            report = Report(folder, study)
            run_trials(folder, study, self._config, self._fixed, report.ended)
            report.summary(self._fixed)
        except KeyboardInterrupt:
            print(f"\nInterrupted; go on with the same command and hydra.run.dir={folder}")
            raise
        finally:
            study.close()


if __name__ == "__main__":
    main()
