"""Trials: ordinary training runs, each in a process of its own that has imported everything already."""

import csv
import fcntl
import json
import math
import multiprocessing
import os
import shutil
import signal
import sys
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

from physai.processes import end_with

OUTPUT = "output.txt"

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["physai.training.run"])


class Evaluation(NamedTuple):
    """An evaluation while a run trains."""

    frames: int
    seconds: float
    success_rate: float


def start(folder: Path, overrides: Sequence[str]) -> BaseProcess:
    """Start the process of a run, which may go on from its last checkpoint; SIGTERM makes it save itself and end.

    Args:
        folder: The run's.
        overrides: Its config.
    """
    process = _CONTEXT.Process(target=_run, args=(os.getpid(), Path.cwd(), folder, list(overrides)))
    process.start()
    return process


def error(folder: Path, code: int) -> str:
    """The last line that a run printed, or what it died of."""
    if code < 0:
        return f"killed by {signal.Signals(-code).name}"
    lines = (folder / OUTPUT).read_text(errors="replace").splitlines() if (folder / OUTPUT).is_file() else []
    return next((line.removeprefix("error: ") for line in reversed(lines) if line.strip()), f"exit code {code}")


def evaluations(folder: Path) -> list[Evaluation]:
    """Read the evaluations of a run so far."""
    try:
        lines = (folder / "metrics.csv").read_text().splitlines(keepends=True)
    except FileNotFoundError:
        return []
    rows = csv.DictReader(line for line in lines if line.endswith("\n"))  # the last is perhaps being written
    keys = ("frames", "time/seconds", "evaluation/success_rate")
    return [Evaluation(int(row[keys[0]]), float(row[keys[1]]), float(row[keys[2]])) for row in rows if row[keys[2]]]


def success_rate(folder: Path) -> float | None:
    """The success rate of the final evaluation; None if the run did not come to its end."""
    path = folder / "summary.json"
    return float(json.loads(path.read_text())["success_rate"]) if path.is_file() else None


def time_to_target(folder: Path, target: float) -> float:
    """Seconds of training until an evaluation first had a success rate; infinity if none has."""
    return next((one.seconds for one in evaluations(folder) if one.success_rate >= target), math.inf)


def _run(starter: int, home: Path, folder: Path, overrides: list[str]) -> None:
    """Be the process of a run."""
    os.setsid()  # Ctrl-C is for the search, which ends its trials
    end_with(starter)
    os.chdir(home)
    folder.mkdir(exist_ok=True)
    fcntl.flock(os.open(folder, os.O_RDONLY), fcntl.LOCK_EX)  # a killed search's process of this run may still save it
    checkpoints = any((folder / "checkpoints").glob("*.pt"))
    if not checkpoints:
        for path in folder.iterdir():
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    output = os.open(folder / OUTPUT, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    os.dup2(output, 1)
    os.dup2(output, 2)
    where = f"resume='{folder}'" if checkpoints else f"hydra.run.dir='{folder}'"
    sys.argv = ["physai.train", *overrides, where]

    from physai import train

    train.main()
