"""What a search shows: a line for each trial, and in the end the best of them."""

import math
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pandas
from rich.markup import escape
from rich.table import Table

from physai import cli
from physai.cli.tables import show
from physai.search.space import overrides
from physai.search.study import Study

_BEST = 10


class Report:
    """A line for each trial that has ended, and a summary of all.

    Args:
        folder: The study's.
        study: It.
    """

    def __init__(self, folder: Path, study: Study) -> None:
        self._folder, self._study = folder, study
        self._objective = "seconds to target" if study.minimize else "success rate"
        self._names = _short_names(study.space)

    def ended(self, run: int) -> None:
        """Show what became of a run."""
        trial = self._study.trials()[run]
        result = {
            "COMPLETE": f"{self._objective} {_short(trial.value)}",
            "PRUNED": "pruned",
            "FAIL": f"failed: {trial.user_attrs.get('error')}",
        }[trial.state.name]
        values = " ".join(f"{self._names[key]}={_short(value)}" for key, value in trial.params.items())
        print(cli.printable(f"[{run}] {result}  ({values})"), flush=True)

    def summary(self, fixed: Sequence[str]) -> None:
        """Write ``study.csv`` and ``study.png``, and show the best trials; exit with code 1 if there are none.

        Args:
            fixed: Overrides of all trials.
        """
        from physai.plots.study import plot_study

        trials = self._study.trials()
        rows = [
            {"run": run, "state": trial.state.name.lower(),
             self._objective: trial.value if trial.state.name == "COMPLETE" else None, **trial.params}
            for run, trial in sorted(trials.items())
        ]  # fmt: skip
        table = pandas.DataFrame(rows)
        table.to_csv(self._folder / "study.csv", index=False)
        best = table[table[self._objective] < math.inf].sort_values(self._objective, ascending=self._study.minimize)
        if best.empty:
            what = "reached the target" if self._study.minimize else "came to an end"
            print(f"error: none of {len(rows)} trials {what}; the output.txt of each says why", file=sys.stderr)
            sys.exit(1)
        shown = Table(title=escape(f"{self._folder}: the best of {len(rows)} trials"), title_justify="left")
        for column in ("run", self._objective, *self._names.values()):
            shown.add_column(escape(column), justify="left" if column == "run" else "right")
        for row in best.head(_BEST).to_dict("records"):
            shown.add_row(*(escape(_short(row[column])) for column in ("run", self._objective, *self._names)))
        show(shown)
        plot_study(table, self._objective, self._study.minimize, self._names, self._folder / "study.png")
        print(f"All trials: {self._folder / 'study.csv'}, {self._folder / 'study.png'}. Train with the best values:")
        values = trials[int(best["run"].iloc[0])].params
        print("  python -m physai.train " + shlex.join([*fixed, *overrides(values)]))


def _short_names(keys: Iterable[str]) -> dict[str, str]:
    """The last word of each key, or all of it where two have the same."""
    keys = sorted(keys)
    last = [key.rpartition(".")[2] for key in keys]
    return {key: name if last.count(name) == 1 else key for key, name in zip(keys, last, strict=True)}


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
