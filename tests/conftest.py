"""What tests share: one thread, and the environments that physai comes with."""

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from hypothesis import HealthCheck, settings
from omegaconf import OmegaConf

from physai.config import compose, conf_dir, validate
from physai.envs.simulation import EnvConfig

# A shell that starts the tests in the background has them, and whatever they start, take no notice of Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine is no fault of a test: how long an example takes says nothing.
settings.register_profile("physai", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("physai")


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    torch.set_num_threads(1)


def _env_config(name: str, *overrides: str) -> EnvConfig:
    return validate(EnvConfig, compose("train", [f"env={name}", *overrides]).env)


@pytest.fixture(scope="session")
def env_config() -> Callable[..., EnvConfig]:
    """Compose the config of an env by name: ``env_config("reacher", "env.task.max_steps=5")``."""
    return _env_config


@pytest.fixture(scope="session")
def reacher() -> EnvConfig:
    return _env_config("reacher")


def _simulated_envs() -> list[str]:
    """All files of ``conf/env`` whose robots are simulated; what is added there is tested, too."""
    names = sorted(path.stem for path in (conf_dir() / "env").glob("*.yaml"))
    return [name for name in names if _env_config(name).simulated]


@pytest.fixture(scope="session")
def kuka_reacher() -> EnvConfig:
    return _env_config("kuka_reacher")


@pytest.fixture(scope="session", params=_simulated_envs())
def any_env(request: pytest.FixtureRequest) -> EnvConfig:
    """Each environment in turn."""
    return _env_config(request.param)


@pytest.fixture(scope="session")
def exported_run(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """A run of the reacher that reaches most goals, with policy.pt and policy.onnx; not to be written to."""
    return _run_once(tmp_path_factory, worker_id, "exported_run", "total_frames=120_000")


@pytest.fixture(scope="session")
def recurrent_run(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """The same, of a policy that remembers."""
    return _run_once(tmp_path_factory, worker_id, "recurrent_run", "policy=gru", "total_frames=80_000")


def _run_once(factory: pytest.TempPathFactory, worker_id: str, name: str, *overrides: str) -> Path:
    from physai.artifact import export_policy  # most tests need no training, and wait for no import of it
    from physai.training.config import TrainConfig
    from physai.training.run import run_training

    base = factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent  # of all workers: one of them trains, the others wait
    run = shared / name
    with FileLock(shared / f"{name}.lock"):
        if not (run / "policy.onnx").exists():
            node = compose("train", [*overrides, "evaluation.episodes=200"])
            (run / ".hydra").mkdir(parents=True)
            (run / ".hydra" / "config.yaml").write_text(OmegaConf.to_yaml(node))
            run_training(validate(TrainConfig, node), run)
            export_policy(run, "best", ["torchscript", "onnx"])
    return run
