"""How long a policy takes for one command, in every form that it has."""

import contextlib
import io
import statistics
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from rich.table import Table
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal

from physai.artifact import FILES, export_policy, onnx
from physai.artifact.module import make_deployable
from physai.bench.timing import reacher, table
from physai.deploy import load_policy
from physai.training.run import TrainedPolicy, run_training

FRAMES = 20_480  # what the policy has learnt does not matter
ROUNDS = 10
CALLS = 1000
LOADS = 20

Call = Callable[[], Any]


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return policy_table(*measure_policy(options.seed))


def measure_policy(seed: int) -> tuple[dict[str, np.ndarray], float]:
    """Return the times of single calls by form, s, and the median time to load a policy file, s."""
    with tempfile.TemporaryDirectory() as folder:
        run, recurrent = Path(folder) / "mlp", Path(folder) / "gru"
        for path in (run, recurrent):
            path.mkdir()
            make_run(path, seed, list(FILES), f"policy={path.name}")
        loads = [_seconds(lambda: load_policy(run / FILES["torchscript"])) for _ in range(LOADS)]
        forms = _forms(run) | {f"policy=gru: {name}": call for name, call in _exported(recurrent).items()}
        times: dict[str, list[list[float]]] = {name: [] for name in forms}
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            for _ in range(ROUNDS + 1):  # they take turns, so that a busy machine slows them alike
                for name, call in forms.items():
                    times[name].append([_seconds(call) for _ in range(CALLS)])
    return {name: np.concatenate(rounds[1:]) for name, rounds in times.items()}, statistics.median(loads)


def make_run(run: Path, seed: int, formats: list[str], *overrides: str) -> None:
    """Train a little, and export the policy in these formats; how good it is does not matter here."""
    print(f"Exporting a policy that has seen {FRAMES:,} frames; how good it is does not matter ...", flush=True)
    sizes = (f"total_frames={FRAMES}", "evaluation.episodes=100", "evaluation.in_a_row=0")
    train_run(run, seed, *sizes, *overrides)
    export_policy(run, "best", formats, episodes=10)


def train_run(run: Path, seed: int, *overrides: str) -> None:
    """Train in an empty folder, without a word."""
    config = reacher(seed, *overrides)
    torch.set_num_threads(config.threads)
    (run / ".hydra").mkdir()
    (run / ".hydra" / "config.yaml").write_text(OmegaConf.to_yaml(config.model_dump(mode="json")))
    with contextlib.redirect_stdout(io.StringIO()):
        run_training(config, run)


def _exported(run: Path) -> dict[str, Call]:
    """An exported policy, in its three forms."""
    actor, env = TrainedPolicy(run, "best").deploy(1, seed=0)
    moment = env.reset()
    eager = make_deployable(actor, env)
    policy = load_policy(run / FILES["torchscript"])
    runtime = onnx.Runtime((run / FILES["onnx"]).read_bytes())
    inputs = [moment.get(signal.name) for signal in policy.metadata.inputs]
    arrays = [value[0].numpy() for value in inputs]
    env.close()
    return {
        "artifact, eager": lambda: eager(*inputs),
        "policy.pt, NumPy to NumPy": lambda: policy(*arrays),
        "policy.onnx in ONNX Runtime": lambda: runtime(*inputs),
    }


def _forms(run: Path) -> dict[str, Call]:
    actor, env = TrainedPolicy(run, "best").deploy(1, seed=0)
    moment = env.reset()
    sensed = {signal.name: moment.get(signal.name) for signal in env.simulation.sensed}
    size, joints = sum(moment.get(key).shape[-1] for key in actor.in_keys), env.action_spec.shape[-1]
    stock, silent = _stock_actor(size, joints, log_prob=True), _stock_actor(size, joints, log_prob=False)
    seen = TensorDict({"seen": torch.randn(1, size)}, [1])
    transforms = list(env.transform)[-2:]  # observation and its normalization

    def pipeline() -> None:
        tensordict = TensorDict(dict(sensed), [1])
        for transform in transforms:
            transform._step(tensordict, tensordict)
        stock(tensordict.set("seen", torch.cat([tensordict.get(key) for key in actor.in_keys], dim=-1)))

    env.close()
    return {
        "TorchRL's stock actor": lambda: stock(seen),
        "... without log-probability": lambda: silent(seen),
        "... behind the env's transforms": pipeline,
        **_exported(run),
    }


def _stock_actor(inputs: int, joints: int, log_prob: bool) -> ProbabilisticActor:
    """What TorchRL's tutorials build for PPO, with the sizes of our actor."""
    network = nn.Sequential(MLP(inputs, 2 * joints, num_cells=[64, 64]), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["seen"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=log_prob,
    )


def _seconds(call: Call) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def policy_table(times: dict[str, np.ndarray], load: float) -> Table:
    """Show each form's median and 99th percentile, and the median as a ratio to the first."""
    shown = table(f"One command for one robot; load_policy takes {load * 1e3:.0f} ms", "", "median", "p99", "ratio")
    first = np.median(next(iter(times.values())))
    for name, seconds in times.items():
        median, slow = np.median(seconds), np.percentile(seconds, 99)
        shown.add_row(name, f"{median * 1e6:.1f} µs", f"{slow * 1e6:.1f} µs", f"{median / first:.2f}")
    return shown
