"""Runs that are small enough to test with."""

import contextlib
import csv
import json
import os
from collections.abc import Callable
from pathlib import Path

from omegaconf import OmegaConf

from physai.config import validate
from physai.training.agent import Agent
from physai.training.callbacks import EvaluationCallback
from physai.training.config import TrainConfig
from physai.training.run import load_config, make_trainer, run_training
from tests.composed import composed
from tests.forge import Forked

SMALL = (
    "total_frames=8192",
    "checkpoint.every_frames=2048",
    "evaluation.every_frames=4096",
    "evaluation.goals=16",
    "evaluation.episodes=32",
    "evaluation.in_a_row=2",
    "collector.num_envs=16",
    "collector.frames_per_batch=1024",
    "algo.minibatch_size=256",
    "export.formats=[]",  # which takes three times as long as all the rest
)

# Runs of which several processes step a share of the robots each.
SIZES = (*SMALL, "total_frames=16384", "collector.num_envs=64", "env.task.max_steps=40")

# Runs of two iterations, episodes of 20 steps: for tests of what starts them.
TINY = (
    "total_frames=1024",
    "checkpoint.every_frames=512",
    "evaluation.every_frames=512",
    "evaluation.goals=8",
    "evaluation.episodes=8",
    "evaluation.in_a_row=1",
    "env.task.max_steps=20",
    "collector.num_envs=16",
    "collector.frames_per_batch=512",
    "algo.minibatch_size=128",
    "export.formats=[]",
)
EXPORTED = "export.formats=[torchscript,onnx]"  # as by default


def small_config(*overrides: str) -> TrainConfig:
    return validate(TrainConfig, composed(*SMALL, *overrides))


def command(module: str, *arguments: str, cwd: Path, finalize: bool = False) -> Forked:
    """Start a physai command as a user would, in a process and a session of its own."""
    return Forked(f"physai.{module}", arguments, cwd, os.environ | {"COLUMNS": "200"}, finalize)


def metrics(run: Path) -> list[dict[str, str]]:
    """``metrics.csv`` without its time columns."""
    with open(run / "metrics.csv") as file:
        return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)]


def run_here(run: Path, *overrides: str) -> None:
    """Train in this process, which has imported everything already, in a folder that is not there yet."""
    (run / ".hydra").mkdir(parents=True)
    node = composed(*overrides)
    (run / ".hydra" / "config.yaml").write_text(OmegaConf.to_yaml(node))
    run_training(validate(TrainConfig, node), run)


def undisturbed(once: Callable[[str, Callable[[Path], None]], Path], collector: str) -> Path:
    """A whole run of ``SIZES`` with a collector, made once; Ray's are those of ``multi_sync``."""
    return once(f"undisturbed_{collector}", lambda at: run_here(at / "run", *SIZES, f"collector={collector}")) / "run"


def train_here(config: TrainConfig, run: Path, resume: bool = False) -> Agent:
    """Train, without the evaluation at the end; return the agent, closed."""
    agent = Agent.build(config)
    with contextlib.closing(agent):
        make_trainer(config, run, agent, EvaluationCallback(config), resume).fit()
    return agent


def resume_here(run: Path) -> None:
    """Go on with a run in this process."""
    run_training(load_config(run), run, resume=True)


def forget_after(run: Path, frames: int) -> None:
    """Leave of a complete run what it would have been found with, had it been killed right after its last batch."""
    later = [path for path in (run / "checkpoints").glob("0*.pt") if int(path.stem) > frames]
    assert later
    for path in (*later, run / "checkpoints" / "best.pt", run / "summary.json"):
        path.unlink()


def assert_same_run(ours: Path, theirs: Path) -> None:
    """See that two complete runs are one, to the last bit."""
    first, second = (json.loads((run / "summary.json").read_text()) for run in (ours, theirs))
    assert first["frames"] == second["frames"]
    assert metrics(ours) == metrics(theirs)
    assert (ours / "episodes.csv").read_bytes() == (theirs / "episodes.csv").read_bytes()
    assert first["weights_sha256"] == second["weights_sha256"]
