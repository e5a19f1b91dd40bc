"""physai: the shortest trustworthy way from a simulated robot arm to a policy on a ROS 2 robot.

Importing it registers an id for each file of ``conf/env`` with Gymnasium, where that is installed, such as
``physai/PandaReach-v0``, one with exchangeable goals, ``physai/PandaReachGoal-v0``, and ``physai/RosReach-v0`` for the
robot of any of these files behind ROS topics. It also sets how Ray behaves, where nothing else is said. It imports
nothing heavy.
"""

import importlib.util
import os
from typing import TYPE_CHECKING, Any

from physai.errors import UserError

if TYPE_CHECKING:
    from physai.envs.make import TransformedRobotEnv

__version__ = "0.1.0"
__all__ = ["UserError", "make_env"]

# Ray reads these when it is imported, which importing TorchRL does.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # it would report its use to its makers
# Its processes would be nice (15) to all others, and the learner, which waits for them, with them: where two other
# processes compute, they took five minutes to start.
os.environ.setdefault("RAY_worker_niceness", "0")
# Of a computer that is gone, it prints the last lines of its log; physai says so in one line.
os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", "^(Raylet is terminated|The node with node id)")

_GYMNASIUM_IDS = {
    "Reacher": "reacher",
    "KukaReacher": "kuka_reacher",
    "PandaReach": "panda_reach",
    "PandaPose": "panda_pose",
    "Kuka7Reach": "kuka7_reach",
    "XarmReach": "xarm_reach",
    "A1Walk": "a1_walk",
}
_WITHOUT_PLACES = ("A1Walk",)  # whose goals are not where an end effector can be


def make_env(*args: Any, **kwargs: Any) -> "TransformedRobotEnv":
    """Make a batched TorchRL env by name: see :func:`physai.envs.make.make`."""
    from physai.envs.make import make

    return make(*args, **kwargs)


def _register() -> None:
    from gymnasium import register

    for name, env in _GYMNASIUM_IDS.items():
        register(
            f"physai/{name}-v0",
            entry_point="physai.envs.gym_env:RobotGymEnv",
            vector_entry_point="physai.envs.gym_env:RobotVectorEnv",
            kwargs={"env": env},
        )
        if name in _WITHOUT_PLACES:
            continue
        register(f"physai/{name}Goal-v0", entry_point="physai.envs.goal_env:GoalGymEnv", kwargs={"env": env})
    register(
        "physai/RosReach-v0",
        entry_point="physai.ros.bridge.gym_env:RosGymEnv",
        kwargs={"env": "reacher"},
        nondeterministic=True,  # in real time nothing moves twice in exactly the same way
    )


if importlib.util.find_spec("gymnasium") is not None:  # a robot that only runs policies may not have it
    _register()
