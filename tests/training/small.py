"""Runs that are small enough to test with."""

import csv
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from physai.config import compose, validate
from physai.training.config import TrainConfig

SMALL = (
    "total_frames=16384",
    "checkpoint.every_frames=2048",
    "evaluation.every_frames=8192",
    "evaluation.goals=16",
    "evaluation.episodes=32",
    "collector.num_envs=16",
    "collector.frames_per_batch=1024",
    "algo.minibatch_size=256",
)


def small_config(*overrides: str) -> TrainConfig:
    return validate(TrainConfig, compose("train", [*SMALL, *overrides]))


def command(module: str, *arguments: str, cwd: Path, **options: Any) -> subprocess.Popen[str]:
    """Start a physai command as a user would, in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", f"physai.{module}", *arguments],
        cwd=cwd,
        env=os.environ | {"COLUMNS": "200"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )


def metrics(run: Path) -> list[dict[str, str]]:
    """``metrics.csv`` without its time columns."""
    with open(run / "metrics.csv") as file:
        return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)]
