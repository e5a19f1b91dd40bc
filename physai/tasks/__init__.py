"""Tasks: what robots shall do, and how a step of theirs is judged."""

from physai.tasks.interface import ObservationModule, Step, Task
from physai.tasks.reach import Reach
from physai.tasks.reach_pose import ReachPose
from physai.tasks.reach_position import ReachPosition
from physai.tasks.reachable import ReachableGoals
from physai.tasks.walk import Walk

__all__ = ["ObservationModule", "Reach", "ReachPose", "ReachPosition", "ReachableGoals", "Step", "Task", "Walk"]
