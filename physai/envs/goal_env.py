"""A Gymnasium env whose goals can be exchanged afterwards, as hindsight experience replay wants it."""

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from physai.envs.gym_env import RobotGymEnv
from physai.errors import UserError
from physai.signals import Quantity

Array = NDArray[Any]


class GoalGymEnv(RobotGymEnv):
    """One robot at a task with goals in space, without randomization.

    An observation is a dict, as in Gymnasium-Robotics' ``GoalEnv`` and panda-gym: ``observation`` (joint positions,
    rad, velocities, rad/s, and where the end effector is), ``achieved_goal`` (the same place or pose) and
    ``desired_goal``. The reward is 0 at the goal and -1 elsewhere (Andrychowicz et al., 2017), whatever the task's is.
    ``info`` and the arguments are those of :class:`RobotGymEnv`.

    Raises:
        UserError: If the env's goals are neither positions nor poses.
    """

    def __init__(self, env: str, **options: Any) -> None:
        super().__init__(env, **options)
        goal, spec = self.simulation.task.goal, self.simulation.spec
        if goal.quantity not in (Quantity.POSITION, Quantity.POSE):
            raise UserError(f"'{env}' has goals of {goal.quantity.value}: only positions and poses can be exchanged")
        self._tolerance = np.array([tolerance.value for tolerance in self.simulation.task.tolerances])
        reach = self.simulation.kinematics.reach + float(np.linalg.norm(self.simulation.kinematics.shoulder))
        place = spaces.Box(np.float32(-reach), np.float32(reach), (goal.size,), np.float32)
        if goal.quantity is Quantity.POSE:
            most = np.array([reach] * 3 + [1.0] * 4, np.float32)
            place = spaces.Box(-most, most, dtype=np.float32)
        low, high = (bound[: 2 * len(spec.joints)] for bound in self.simulation.task.observation.bounds)
        low, high = (np.concatenate(ends).astype(np.float32) for ends in ((low, place.low), (high, place.high)))
        seen = spaces.Box(low, high, dtype=np.float32)
        self.observation_space = spaces.Dict(  # type: ignore[assignment]
            {"observation": seen, "achieved_goal": place, "desired_goal": place}
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        _, info = super().reset(seed=seed, options=options)
        return self._observe(), info

    def step(self, action: Array) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply an action [n] in [-1, 1] for one control period."""
        _, _, terminated, truncated, info = super().step(action)
        observation = self._observe()
        reward = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
        return observation, float(reward), terminated, truncated, info

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Array:
        """Return 0 where one goal, [g] or [N, g], is within the tolerances of the other, and -1 elsewhere."""
        distance = np.linalg.norm(achieved_goal[..., :3] - desired_goal[..., :3], axis=-1)
        near = distance < self._tolerance[0]
        if self.simulation.task.goal.quantity is Quantity.POSE:
            cosine = np.abs((achieved_goal[..., 3:] * desired_goal[..., 3:]).sum(axis=-1))
            near &= 2.0 * np.arccos(np.clip(cosine, 0.0, 1.0)) < self._tolerance[1]
        return np.where(near, np.float32(0.0), np.float32(-1.0))

    def _observe(self) -> dict[str, Array]:
        state, goal = self.simulation.state, self.simulation.task.goal
        joint_position = torch.from_numpy(state.joint_position).float()
        with torch.no_grad():
            linear, rotation, _ = self.simulation.kinematics.linearize_pose(
                torch.cos(joint_position), torch.sin(joint_position)
            )
        place = linear[0, : min(goal.size, 3), -1].numpy()
        if goal.quantity is Quantity.POSE:
            place = np.concatenate([place, Rotation.from_matrix(rotation[0].numpy()).as_quat(canonical=True)])
        achieved = place.astype(np.float32)
        observation = np.concatenate([state.joint_position[0], state.joint_velocity[0], achieved]).astype(np.float32)
        desired = self.simulation.goal[0].astype(np.float32)
        return {"observation": observation, "achieved_goal": achieved, "desired_goal": desired}
