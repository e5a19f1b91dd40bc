"""Types and ranges of ``conf/search.yaml``; the values are there."""

from typing import Annotated, Literal

from pydantic import Field

from physai.config import Config, Count
from physai.training.config import TrainConfig


class StudyConfig(Config):
    """What is searched for, and how."""

    trials: Count
    jobs: Count
    prune: bool
    objective: Literal["success_rate", "time_to_target"]
    target: Annotated[float, Field(gt=0, le=1)]
    ranges: dict[str, str]

    @property
    def minimize(self) -> bool:
        """Whether the best is the smallest."""
        return self.objective == "time_to_target"


class SearchConfig(TrainConfig):
    """What is common to all trials, and the search."""

    search: StudyConfig
