"""What all measurements share: sides that take turns, the config they measure, and tables."""

import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from rich.table import Table

from physai.compose import compose
from physai.config import validate
from physai.training.config import TrainConfig


def machine() -> str:
    """Describe what the figures are measured on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model = models[0] if models else platform.processor() or platform.machine()
    packages = [name for name in ("torch", "torchrl", "pybullet", "stable_baselines3") if find_spec(name)]
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return (
        f"{model}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n"
        f"Python {platform.python_version()}, {versions}"
    )


def timed(work: Callable[[], int]) -> tuple[int, float]:
    """Return what ``work`` says it did, and the seconds that it took."""
    started = time.perf_counter()
    done = work()
    return done, time.perf_counter() - started


def median_speeds(*sides: Callable[[], int], rounds: int) -> list[float]:
    """Return each side's median work per second; they take turns, so that a busy machine slows them alike."""
    for side in sides:
        side()
    results = [[timed(side) for side in sides] for _ in range(rounds)]
    return [statistics.median(done / seconds for done, seconds in side) for side in zip(*results, strict=True)]


def reacher(seed: int, *overrides: str) -> TrainConfig:
    """The config that is measured."""
    return config_of("reacher", seed, *overrides)


def config_of(env: str, seed: int, *overrides: str) -> TrainConfig:
    """The config of an env."""
    return validate(TrainConfig, compose("train", [f"env={env}", f"seed={seed}", *overrides]))


def table(title: str, *columns: str) -> Table:
    """A table of figures."""
    made = Table(title=title, title_justify="left", min_width=len(title))
    for column in columns:
        made.add_column(column, justify="right")
    return made


def cpu_seconds(pid: int) -> float:
    """Return the time that a process has computed, by itself and in the kernel."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
