"""What tests share: one thread, and the two environments that physai comes with."""

from collections.abc import Callable

import pytest
import torch

from physai.config import compose, validate
from physai.envs.simulation import EnvConfig


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
