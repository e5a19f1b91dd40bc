"""A robot behind ROS topics as a Gymnasium env."""

from collections.abc import Sequence

from physai.envs.gym_env import RobotGymEnv


class RosReacherEnv(RobotGymEnv):
    """``physai/Reacher-v0`` on a robot behind ROS topics, in real time; every episode starts at home.

    Args:
        env: A file of ``conf/env``.
        render_mode: See :class:`physai.envs.gym_env.RobotGymEnv`.
        overrides: Hydra overrides such as ``env.task.max_steps=100``.

    Raises:
        UserError: If there is no robot, or somebody else commands it.
    """

    def __init__(self, env: str = "ros_reacher", render_mode: str | None = None, overrides: Sequence[str] = ()) -> None:
        super().__init__(env, render_mode, overrides)
