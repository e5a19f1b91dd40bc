"""Types and ranges of ``conf/train.yaml``; the values are there."""

from typing import Annotated, Literal

from pydantic import Field

from physai.collectors import CollectorConfig
from physai.config import Config, Count, PackageName, Seed
from physai.envs.make import NormalizationConfig
from physai.envs.simulation import EnvConfig
from physai.physics import RandomizationConfig
from physai.targets import Target


class CheckpointConfig(Config):
    """When to save, and how many files to keep."""

    every_frames: Count
    keep: Count


class EvaluationConfig(Config):
    """How the policy is judged while it trains, and at the end."""

    every_frames: Count
    goals: Count
    episodes: Count
    in_a_row: Annotated[int, Field(ge=0)]
    randomization: RandomizationConfig


class ExportConfig(Config):
    """What the best policy becomes, and whether it must succeed in another engine."""

    formats: list[Literal["torchscript", "onnx"]]
    transfer: Literal["report", "require"]


class PolicyConfig(Config):
    """One file of ``conf/policy``."""

    actor: Target
    critic: Target

    @property
    def memory_size(self) -> int:
        """How many numbers the actor remembers from step to step."""
        return int(self.actor.get("memory_size", 0))


class TrainConfig(Config):
    """Everything that decides the outcome of a run."""

    env: EnvConfig
    physics: Target  # what an env refers to that brings none along
    algo: Target
    policy: PolicyConfig
    collector: CollectorConfig
    randomization: RandomizationConfig
    normalization: NormalizationConfig
    checkpoint: CheckpointConfig
    evaluation: EvaluationConfig
    export: ExportConfig
    logger: Target
    seed: Seed
    total_frames: Count
    device: Annotated[str, Field(pattern=r"^(cpu|cuda(:\d+)?)$")]
    threads: Count
    resume: None  # the command takes it before a config is made
    allow: list[PackageName]  # for resume: what a new run names is the user's own
