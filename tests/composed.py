"""Configs that are composed once, which takes a sixth of a second; in `make test` once for all workers."""

import hashlib
import os
import pickle
from functools import cache
from pathlib import Path

from filelock import FileLock
from omegaconf import DictConfig

from physai.compose import compose, conf_dir
from physai.config import validate
from physai.envs.simulation import EnvConfig
from physai.physics import RandomizationConfig


@cache
def _pickled(*overrides: str) -> bytes:
    if "PHYSAI_TEST_RUNS" not in os.environ:
        return pickle.dumps(compose("train", overrides))
    changed = max(path.stat().st_mtime_ns for path in conf_dir().rglob("*.yaml"))
    name = hashlib.sha256(repr((overrides, changed)).encode()).hexdigest()
    shared = Path(os.environ["PHYSAI_TEST_RUNS"]) / f"composed_{name}"
    with FileLock(f"{shared}.lock"):
        if not shared.exists():
            shared.write_bytes(pickle.dumps(compose("train", overrides)))
        return shared.read_bytes()


def composed(*overrides: str) -> DictConfig:
    """What a training is composed to, of the caller's own."""
    return pickle.loads(_pickled(*overrides))


@cache
def env_config(name: str, *overrides: str) -> EnvConfig:
    """The config of an env by name: ``env_config("reacher", "env.task.max_steps=5")``."""
    return validate(EnvConfig, composed(f"env={name}", *overrides).env)


@cache
def randomization(name: str) -> RandomizationConfig:
    """A file of ``conf/randomization``."""
    return validate(RandomizationConfig, composed(f"randomization={name}").randomization)
