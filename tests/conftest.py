"""What tests share: one thread, and the two environments that physai comes with."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from hypothesis import HealthCheck, settings
from omegaconf import OmegaConf

from physai.artifact import export_policy
from physai.config import compose, validate
from physai.envs.simulation import EnvConfig
from physai.training.config import TrainConfig
from physai.training.run import run_training

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


@pytest.fixture(scope="session")
def kuka_reacher() -> EnvConfig:
    return _env_config("kuka_reacher")


@pytest.fixture(scope="session", params=["reacher", "kuka_reacher"])
def any_env(request: pytest.FixtureRequest) -> EnvConfig:
    """Each environment in turn."""
    return _env_config(request.param)


@pytest.fixture(scope="session")
def exported_run(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """A run of the reacher that reaches most goals, with policy.pt and policy.onnx; not to be written to."""
    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent  # of all workers: one of them trains, the others wait
    run = shared / "exported_run"
    with FileLock(shared / "exported_run.lock"):
        if not (run / "policy.onnx").exists():
            overrides = ["total_frames=120_000", "evaluation.episodes=200"]
            node = compose("train", overrides)
            (run / ".hydra").mkdir(parents=True)
            (run / ".hydra" / "config.yaml").write_text(OmegaConf.to_yaml(node))
            run_training(validate(TrainConfig, node), run)
            export_policy(run, "best", ["torchscript", "onnx"])
    return run
