"""Tasks: what robots shall do, and how a step of theirs is judged."""

from physai.tasks.interface import ObservationModule, Step, Task
from physai.tasks.reach import Reach

__all__ = ["ObservationModule", "Reach", "Step", "Task"]
