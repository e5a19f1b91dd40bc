"""Small collectors to test with."""

import torch

from physai.collectors import CollectorConfig, FrameSource, make_collector
from physai.config import validate
from physai.envs.make import TransformedRobotEnv, make_env
from physai.policies import GaussianActor
from physai.training.config import TrainConfig
from tests.composed import composed

RAY = {"address": "local", "include_dashboard": False, "log_to_driver": False, "logging_level": "error"}
KINDS = {
    "single": {"processes": 1, "sync": True, "ray_init": None},
    "async": {"processes": 1, "sync": False, "ray_init": None},
    "multi_sync": {"processes": 2, "sync": True, "ray_init": None},
    "multi_async": {"processes": 2, "sync": False, "ray_init": None},
    "ray": {"processes": 2, "sync": True, "ray_init": RAY},
}
CPU = torch.device("cpu")
ENV = validate(TrainConfig, composed())  # composed before workers are forked, each of which would


def robots(num_envs: int, seed: int) -> TransformedRobotEnv:
    return make_env(ENV.env, ENV.randomization, ENV.normalization, num_envs, seed)


def actor(std: float = 1.0) -> GaussianActor:
    torch.manual_seed(0)
    return GaussianActor(8, 2, ["normalized_observation"], [16], "torch.nn.Tanh", std)


def config(kind: str, num_envs: int = 8, frames_per_batch: int = 128) -> CollectorConfig:
    return CollectorConfig(num_envs=num_envs, frames_per_batch=frames_per_batch, **KINDS[kind])


def source(kind: str, policy: GaussianActor, env: TransformedRobotEnv, total=1024, seed=0, warmup=0) -> FrameSource:
    return make_collector(config(kind), env, robots, policy, total, seed, warmup, CPU)


def assert_equal(ours, theirs):
    for key in ours.keys(True, True):
        assert torch.equal(ours[key], theirs[key]), key
