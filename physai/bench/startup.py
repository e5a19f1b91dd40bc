"""How soon a command answers, how soon it trains, and how long an evaluation takes."""

import statistics
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from pathlib import Path

from rich.table import Table

from physai.bench.policy import train_run
from physai.bench.timing import table, timed
from physai.errors import UserError
from physai.training.checkpoint import CheckpointFolder
from physai.training.evaluation import evaluate
from physai.training.run import FINAL_SEED, TrainedPolicy

ROUNDS = 5
EPISODES = 1000
TRAINING: tuple[str, ...] = ()  # overrides; how far the policy is decides how long its episodes are
_LIBRARIES = "import torch, torchrl.envs, pybullet, urdf_parser_py.urdf, hydra"  # what training cannot do without
_IMPORT = "import physai"
_HELP = "physai.train --help"
_FIRST_FRAME = "physai.train, first frame"
_BUILD = f"building {EPISODES:,} robots"
_EVALUATE = f"{EPISODES:,} episodes in one pass"
_PATIENCE = 60.0  # s


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return startup_table(measure_startup(options.seed))


def measure_startup(seed: int) -> dict[str, list[float]]:
    """Return seconds by what is waited for: processes from their start, and a trained policy's final evaluation.

    Raises:
        UserError: If training does not start.
    """
    seconds: dict[str, list[float]] = {
        name: [] for name in (_LIBRARIES, _IMPORT, _HELP, _FIRST_FRAME, _BUILD, _EVALUATE)
    }
    print(f"Starting each command {ROUNDS} times ...", flush=True)
    for _ in range(ROUNDS):  # they take turns, so that a busy machine slows them alike
        for statement in (_LIBRARIES, _IMPORT):
            seconds[statement].append(_seconds_of("-c", statement))
        seconds[_HELP].append(_seconds_of("-m", "physai.train", "--help"))
        seconds[_FIRST_FRAME].append(_seconds_to_first_frame(seed))
    print("Training the policy that is judged ...", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        train_run(Path(folder), seed, *TRAINING)
        policy = TrainedPolicy(Path(folder), "best")
        for _ in range(ROUNDS):
            started = time.perf_counter()
            actor, env = policy.deploy(EPISODES, FINAL_SEED)
            seconds[_BUILD].append(time.perf_counter() - started)
            try:
                _, spent = timed(lambda: len(evaluate(actor, env, EPISODES, FINAL_SEED).success))  # noqa: B023
            finally:
                env.close()
            seconds[_EVALUATE].append(spent)
    return seconds


def _seconds_of(*arguments: str) -> float:
    started = time.perf_counter()
    subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
    return time.perf_counter() - started


def _seconds_to_first_frame(seed: int) -> float:
    """Until the checkpoint of zero frames is complete: the loop begins with the next statement."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        checkpoints = CheckpointFolder(run / "checkpoints", 1)
        command = [sys.executable, "-m", "physai.train", "env=reacher", f"seed={seed}", f"hydra.run.dir={run}"]
        started = time.time()
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
            try:
                while not checkpoints.paths() and process.poll() is None and time.time() < started + _PATIENCE:
                    time.sleep(0.01)
            finally:
                process.kill()
            if not checkpoints.paths():
                assert process.stderr is not None
                raise UserError(f"training does not start: {process.stderr.read().strip()[-200:]}")
            return checkpoints.paths()[0].stat().st_mtime - started


def startup_table(seconds: dict[str, list[float]]) -> Table:
    """Show medians and extremes."""
    shown = table("What one waits for, s", "", "median", "shortest", "longest")
    for name, values in seconds.items():
        shown.add_row(name, *(f"{value:.2f}" for value in (statistics.median(values), min(values), max(values))))
    return shown
