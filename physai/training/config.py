"""Types and ranges of ``conf/train.yaml``; the values are there."""

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from physai.collectors import CollectorConfig
from physai.config import Config, Count, PackageName, PageConfig, Seed
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

    def memory_size(self, joints: int) -> int:
        """How many numbers the actor of a robot remembers from step to step."""
        return int(self.actor.get("memory_size", 0)) + joints * int(self.actor.get("past_actions", 0))


_Rate = Annotated[float, Field(ge=0, le=1)]


class AdrConfig(Config):
    """``conf/curriculum/adr.yaml``: automatic domain randomization.

    A share of all episodes, ``pinned``, stands on a boundary. When a boundary has so many ``results``, a success rate
    above ``widen_above`` moves it outwards by ``step``, a share of its whole way, and one below ``narrow_below`` moves
    it back.
    """

    name: Literal["adr"]
    pinned: Annotated[float, Field(gt=0, le=1)]
    results: Count
    widen_above: _Rate
    narrow_below: _Rate
    step: Annotated[float, Field(gt=0, le=1)]

    @model_validator(mode="after")
    def _ordered(self) -> "AdrConfig":
        if self.narrow_below > self.widen_above:
            raise ValueError(f": narrow_below {self.narrow_below} is above widen_above {self.widen_above}")
        return self


class LinearConfig(Config):
    """``conf/curriculum/linear.yaml``: all ranges grow evenly, and are whole when the run ends."""

    name: Literal["linear"]

    @property
    def pinned(self) -> float:
        """The share of episodes that stand on a boundary: none learns anything from them."""
        return 0.0


CurriculumConfig = Annotated[AdrConfig | LinearConfig, Field(discriminator="name")]


class WatchConfig(Config):
    """The part of ``conf/train.yaml`` that shows a run, and decides nothing of its outcome."""

    render: Literal["web"] | None
    web: PageConfig


class TrainConfig(Config):
    """Everything that decides the outcome of a run; what is only for a :class:`WatchConfig` is left out."""

    env: EnvConfig
    physics: Target  # what an env refers to that brings none along
    algo: Target
    policy: PolicyConfig
    collector: CollectorConfig
    randomization: RandomizationConfig
    curriculum: CurriculumConfig | None
    normalization: NormalizationConfig
    checkpoint: CheckpointConfig
    evaluation: EvaluationConfig
    export: ExportConfig
    logger: Target
    seed: Seed
    total_frames: Count
    pretrained: str | None
    device: Annotated[str, Field(pattern=r"^(cpu|cuda(:\d+)?)$")]
    threads: Count
    resume: None  # the command takes it before a config is made
    allow: list[PackageName]  # for resume: what a new run names is the user's own

    @model_validator(mode="before")
    @classmethod
    def _without_watching(cls, values: Any) -> Any:
        return {key: value for key, value in values.items() if key not in WatchConfig.model_fields}

    @property
    def memory_size(self) -> int:
        """How many numbers the policy remembers from step to step."""
        return self.policy.memory_size(len(self.env.robot.joints))
