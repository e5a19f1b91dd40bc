"""Tasks: pure functions on rows of robots."""

from physai.tasks.reach import Reach

__all__ = ["Reach"]
