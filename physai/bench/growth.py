"""What a run costs as it grows: time and memory against frames, and against robots."""

import csv
import json
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

import psutil
from rich.table import Table

from physai.bench.timing import reacher, table
from physai.errors import UserError

FRAMES = (131_072, 262_144, 524_288, 1_048_576)
ROBOTS = (64, 128, 256, 512, 1024)
ROBOTS_FRAMES = 131_072
LOOK_EVERY = 0.2  # s; a look takes milliseconds


@dataclass(frozen=True)
class Run:
    """What one run took.

    Attributes:
        frames: Of its training.
        robots: That they are from.
        seconds: Of its loop alone.
        megabytes: The most memory that its processes had together.
        waited: s, in which its learner had no batch.
        learned: s, in which it learned.
    """

    frames: int
    robots: int
    seconds: float
    megabytes: float
    waited: float
    learned: float


def run(options: Namespace) -> Table:
    """Measure, draw it into ``options.figure``, and show it."""
    series = measure_growth(options.seed)
    growth_figure(*series, options.figure)
    print(f"Figure: {options.figure}")
    return growth_table(*series)


def measure_growth(seed: int) -> tuple[list[Run], list[Run]]:
    """Train with ever more frames, and with ever more robots; each run is a process of its own."""
    robots = reacher(seed).collector.num_envs
    by_frames = [train_apart("reacher", frames, robots, seed) for frames in FRAMES]
    return by_frames, [train_apart("reacher", ROBOTS_FRAMES, robots, seed) for robots in ROBOTS]


def train_apart(env: str, frames: int, robots: int, seed: int, *overrides: str) -> Run:
    """Train in a process of its own, and see how long that takes, and how much memory."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            *(sys.executable, "-m", "physai.train", f"env={env}", f"seed={seed}", f"hydra.run.dir={folder}"),
            *(f"total_frames={frames}", f"collector.num_envs={robots}"),
            "evaluation.episodes=100",  # the thousand robots of the final evaluation would hide the others
            "evaluation.in_a_row=0",  # which takes longer than the loop, and is not on its clock
            "export.formats=[]",  # whose memory is the same for all
            *overrides,
        ]
        megabytes = 0.0
        with open(Path(folder) / "said.txt", "w+") as said:
            process = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT)
            try:
                while process.poll() is None:
                    megabytes = max(megabytes, _memory(process.pid))
                    time.sleep(LOOK_EVERY)
            finally:
                process.kill()  # unless it has ended
                process.wait()
            if process.returncode:
                said.seek(0)
                raise UserError(f"training failed: {said.read()[-1000:]}")
        summary = json.loads((Path(folder) / "summary.json").read_text())
        with open(Path(folder) / "metrics.csv") as file:
            phases = [(float(row["time/collect"]), float(row["time/update"])) for row in csv.DictReader(file)]
    waited, learned = (sum(each) for each in zip(*phases, strict=True))
    run = Run(summary["frames"], robots, summary["train_seconds"], megabytes, waited, learned)
    print(f"{run.frames:>9,} frames, {robots:>5,} robots: {run.seconds:6.1f} s, {run.megabytes:,.0f} MB", flush=True)
    return run


def _memory(pid: int) -> float:
    """Memory of a process and its descendants, MB; what they share counts once."""
    try:
        process = psutil.Process(pid)
        return sum(one.memory_full_info().pss for one in (process, *process.children(recursive=True))) / 2**20
    except (psutil.NoSuchProcess, psutil.AccessDenied):  # one has just ended
        return 0.0


def growth_table(by_frames: list[Run], by_robots: list[Run]) -> Table:
    """Show both series."""
    shown = table("Training time and peak memory", "frames", "robots", "time", "frames/s", "peak memory")
    for series in (by_frames, by_robots):
        for run in series:
            speed, memory = f"{run.frames / run.seconds:,.0f}", f"{run.megabytes:,.0f} MB"
            shown.add_row(f"{run.frames:,}", f"{run.robots:,}", f"{run.seconds:.1f} s", speed, memory)
        shown.add_section()
    return shown


def growth_figure(by_frames: list[Run], by_robots: list[Run], path: Path) -> None:
    """Draw both series, each from zero: a straight line is linear growth, a level one is none."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    sides = zip(figure.subplots(1, 2), (by_frames, by_robots), ("frames", "robots"), strict=True)
    for axes, runs, name in sides:
        sizes = [getattr(run, name) for run in runs]
        axes.plot(sizes, [run.seconds for run in runs], "o-", color="tab:blue")
        axes.set_xlabel(name if name == "frames" else f"robots ({runs[0].frames:,} frames)")
        axes.set_ylabel("training time, s", color="tab:blue")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0, top=1.15 * max(run.seconds for run in runs))
        memory = axes.twinx()
        memory.plot(sizes, [run.megabytes / 1024 for run in runs], "s--", color="tab:orange")
        memory.set_ylabel("peak memory, GB", color="tab:orange")
        memory.set_ylim(bottom=0, top=1.3 * max(run.megabytes for run in runs) / 1024)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1e6:g} M" if value >= 1e5 else f"{value:g}")
        axes.spines["top"].set_visible(False)
        memory.spines["top"].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
