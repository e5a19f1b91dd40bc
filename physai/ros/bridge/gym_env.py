"""A robot behind ROS topics as a Gymnasium env."""

from collections.abc import Sequence

from physai.envs.gym_env import RobotGymEnv


class RosGymEnv(RobotGymEnv):
    """The task of any env of velocity commands, on the one robot behind the topics; see :class:`RobotGymEnv`.

    Args:
        env: A file of ``conf/env``, which names the robot.
        render_mode: ``rgb_array`` renders on the CPU without a screen; ``human`` opens a PyBullet window.
        overrides: Hydra overrides such as ``physics.homing_speed=0.2``.
    """

    def __init__(self, env: str, render_mode: str | None = None, overrides: Sequence[str] = ()) -> None:
        super().__init__(env, render_mode, ["physics=ros", *overrides])
