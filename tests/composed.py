"""Configs that are composed once, which takes a sixth of a second."""

from copy import deepcopy
from functools import cache

from omegaconf import DictConfig

from physai.compose import compose
from physai.config import validate
from physai.envs.simulation import EnvConfig
from physai.physics import RandomizationConfig


@cache
def _composed(*overrides: str) -> DictConfig:
    return compose("train", overrides)


def composed(*overrides: str) -> DictConfig:
    """What a training is composed to, of the caller's own."""
    return deepcopy(_composed(*overrides))


@cache
def env_config(name: str, *overrides: str) -> EnvConfig:
    """The config of an env by name: ``env_config("reacher", "env.task.max_steps=5")``."""
    return validate(EnvConfig, _composed(f"env={name}", *overrides).env)


@cache
def randomization(name: str) -> RandomizationConfig:
    """A file of ``conf/randomization``."""
    return validate(RandomizationConfig, _composed(f"randomization={name}").randomization)
