"""The end of a sweep: one table of all its runs, one plot, and no failure unseen."""

import os
import shlex
import signal
import sys
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table

from physai import study
from physai.errors import UserError

_BEST = 10


class SweepReport(Callback):
    """Hydra callback; exits with code 1 if a run of the sweep failed."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Start Ray where it is the launcher; by itself it would also take over what this command does on a signal."""
        if not config.hydra.launcher._target_.endswith(".RayLauncher"):
            return
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report its use to its makers
        import ray

        arguments = OmegaConf.to_container(config.hydra.launcher.ray.init, resolve=True)
        if arguments.get("address") == "local":
            arguments.setdefault("object_store_memory", 80 * 2**20)  # jobs hand nothing over
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            ray.init(**arguments)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Report on the runs below the sweep's folder."""
        from physai.plots.runs import plot_runs

        folder = Path(config.hydra.sweep.dir)
        if study.searched(config) is not None:
            _report_study(folder)
            return
        runs = sorted((path.parent.parent for path in folder.glob("*/.hydra/overrides.yaml")), key=_number)
        summaries = {run: study.read_summary(run) for run in runs}
        table = Table(title=f"{folder}", title_justify="left")
        for column in ("run", "differs by", "success", "steps", "frames", "seconds"):
            table.add_column(column, justify="left" if column in ("run", "differs by") else "right")
        overrides = {run: list(OmegaConf.load(run / ".hydra" / "overrides.yaml")) for run in runs}
        common = set.intersection(*map(set, overrides.values())) if len(runs) > 1 else set()
        for run, summary in summaries.items():
            differs = " ".join(override for override in overrides[run] if override not in common)
            table.add_row(run.name, differs, *_figures(summary))
        Console().print(table)
        finished = [run for run, summary in summaries.items() if summary]
        if finished:
            try:  # Hydra would turn an error here into a warning, and forget the failures below
                plot_runs(finished, folder / "training.png")
                print(f"Curves of all runs: {folder / 'training.png'}")
            except (UserError, OSError) as error:
                print(f"error: no plot: {error}", file=sys.stderr)
        failed = [run for run in runs if run not in finished]
        for run in failed:
            print(f"error: {run}: {_reason(run)}", file=sys.stderr)
        if failed:
            print(f"error: {len(failed)} of {len(runs)} runs failed", file=sys.stderr)
            sys.exit(1)


def _report_study(folder: Path) -> None:
    """Write ``study.csv`` and ``study.png``, and show the best trials; exit with code 1 if there are none."""
    from physai.plots.study import plot_study

    found = study.load(folder)
    names = study.short_names(key for trial in found.trials for key in trial.params)
    study.write_csv(found, folder / "study.csv")
    over = [(trial.value, trial) for trial in found.trials if trial.value is not None]
    best = sorted(over, key=lambda one: one[0], reverse=found.direction.name == "MAXIMIZE")
    table = Table(title=f"{folder}: the best of {len(over)} trials", title_justify="left")
    for column in ("run", study.objective_name(found), *names.values()):
        table.add_column(column, justify="left" if column == "run" else "right")
    for value, trial in best[:_BEST]:
        table.add_row(str(trial.number), _short(value), *(_short(trial.params.get(key)) for key in names))
    Console().print(table)
    for trial in found.trials:
        if study.failed(folder, trial):
            print(f"error: {folder / str(trial.number)}: {_reason(folder / str(trial.number))}", file=sys.stderr)
    if not best:
        print(f"error: none of {len(found.trials)} trials came to an end", file=sys.stderr)
        sys.exit(1)
    plot_study(found, study.objective_name(found), names, folder / "study.png")
    print(f"All trials: {folder / 'study.csv'}, {folder / 'study.png'}. Train with the best values:")
    print("  python -m physai.train " + shlex.join(study.command(found, best[0][1])))


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else "-" if value is None else str(value)


def _number(run: Path) -> tuple[int, str]:
    return (int(run.name) if run.name.isdigit() else 0, run.name)


def _reason(run: Path) -> str:
    error = run / "error.txt"
    return error.read_text().splitlines()[0] if error.is_file() else "it did not finish"


def _figures(summary: dict[str, Any] | None) -> list[str]:
    if summary is None:
        return ["[red]failed[/red]", "", "", ""]
    steps = summary["steps_to_goal"]
    return [
        f"{summary['success_rate']:.1%}",
        "-" if steps is None else f"{steps:.0f}",
        f"{summary['frames']:,}",
        f"{summary['train_seconds']:.1f}",
    ]
