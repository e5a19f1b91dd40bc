"""The end of a sweep: one table of all its runs, one plot, and no failure unseen."""

import json
import signal
import sys
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from physai.cli.tables import show
from physai.errors import UserError
from physai.processes import handling


class SweepReport(Callback):
    """Hydra callback; exits with code 1 if a run of the sweep failed."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Start Ray where it is the launcher; by itself it would also take over what this command does on a signal."""
        if not config.hydra.launcher._target_.endswith(".RayLauncher"):
            return
        import ray

        arguments = OmegaConf.to_container(config.hydra.launcher.ray.init, resolve=True)
        if arguments.get("address") == "local":
            arguments.setdefault("object_store_memory", 80 * 2**20)  # jobs hand nothing over
        with handling((signal.SIGINT, signal.SIGTERM)):
            ray.init(**arguments)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Report on the runs below the sweep's folder."""
        from physai.plots.runs import plot_runs

        folder = Path(config.hydra.sweep.dir)
        runs = sorted((path.parent.parent for path in folder.glob("*/.hydra/overrides.yaml")), key=_number)
        summaries = {run: _summary(run) for run in runs}
        table = Table(title=f"{folder}", title_justify="left")
        for column in ("run", "differs by", "success", "settled", "steps", "frames", "seconds"):
            table.add_column(column, justify="left" if column in ("run", "differs by") else "right")
        overrides = {run: list(OmegaConf.load(run / ".hydra" / "overrides.yaml")) for run in runs}
        common = set.intersection(*map(set, overrides.values())) if len(runs) > 1 else set()
        for run, summary in summaries.items():
            differs = " ".join(override for override in overrides[run] if override not in common)
            table.add_row(run.name, differs, *_figures(summary))
        show(table)
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


def _summary(run: Path) -> dict[str, Any] | None:
    path = run / "summary.json"
    return json.loads(path.read_text()) if path.is_file() else None


def _number(run: Path) -> tuple[int, str]:
    return (int(run.name) if run.name.isdigit() else 0, run.name)


def _reason(run: Path) -> str:
    error = run / "error.txt"
    return error.read_text().splitlines()[0] if error.is_file() else "it did not finish"


def _figures(summary: dict[str, Any] | None) -> list[str]:
    if summary is None:
        return ["[red]failed[/red]", "", "", "", ""]
    steps = summary["steps_to_goal"]
    return [
        f"{summary['success_rate']:.1%}",
        f"{summary['settled_rate']:.1%}",
        "-" if steps is None else f"{steps:.0f}",
        f"{summary['frames']:,}",
        f"{summary['train_seconds']:.1f}",
    ]
