"""Configs that are composed once, which takes a sixth of a second; in `make test` once for all workers."""

import hashlib
import os
import pickle
from functools import cache
from pathlib import Path

from filelock import FileLock
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf

from physai.compose import compose, conf_dir, parse
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
    """What a training is composed to, of the caller's own; not for files of one's own, which may change.

    Hydra composes only the choices, once; plain values are set in a copy, as Hydra would.
    """
    parsed = parse(overrides)
    if not all(_is_plain(one) for one in parsed):
        return pickle.loads(_pickled(*overrides))
    node = pickle.loads(_pickled(*(one.input_line for one in parsed if _is_choice(one))))
    for one in parsed:
        if not _is_choice(one):
            OmegaConf.update(node, one.key_or_group, one.value())
    return node


def _is_plain(override: Override) -> bool:
    return override.type == OverrideType.CHANGE and not override.is_hydra_override()


def _is_choice(override: Override) -> bool:
    return override.package is not None or (conf_dir() / override.key_or_group).is_dir()


@cache
def env_config(name: str, *overrides: str) -> EnvConfig:
    """The config of an env by name: ``env_config("reacher", "env.task.max_steps=5")``."""
    return validate(EnvConfig, composed(f"env={name}", *overrides).env)


@cache
def randomization(name: str) -> RandomizationConfig:
    """A file of ``conf/randomization``."""
    return validate(RandomizationConfig, composed(f"randomization={name}").randomization)
