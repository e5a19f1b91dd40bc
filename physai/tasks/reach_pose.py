"""Reach a pose: bring the end effector to a point in space, turned in a certain way."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from physai.config import PositiveFloat
from physai.robots import ForwardKinematics, RobotSpec, angle_between, quaternion_matrix, rotation_vector
from physai.signals import Quantity, Region, Signal, Tolerance
from physai.tasks.interface import ObservationModule
from physai.tasks.reach_position import Posture, goals_in, space_observation
from physai.tasks.reaching import Reaching


class ReachPoseObservation(ObservationModule):
    """As :class:`physai.tasks.reach_position.ReachPositionObservation`, with what turns the end effector.

    The observation is ``[q, qd, ee, goal]``, where of a goal's orientation the first two columns of its rotation matrix
    are seen: they do not jump (Zhou et al., CVPR 2019), and are the same for a quaternion and its opposite. To the
    features come the rotation vector r from the end effector to the goal and J_ωᵀr, the direction in joint space that
    shortens it fastest.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        tolerance: Distance that counts as reached, m.
        angle_tolerance: Angle that counts as reached, rad.
    """

    def __init__(
        self, spec: RobotSpec, kinematics: ForwardKinematics, tolerance: float, angle_tolerance: float
    ) -> None:
        super().__init__()
        self.kinematics = kinematics
        length, n = kinematics.reach, len(spec.joints)
        joints = [1.0 / (length * tolerance)] * n + [0.5 / angle_tolerance] * n
        coarse = [2.0 / length] * 3 + [1.0 / math.pi] * 3 + [0.25 * each for each in joints]
        fine = [0.5 / tolerance] * 3 + [0.5 / angle_tolerance] * 3 + joints
        self.coarse: Tensor
        self.fine: Tensor
        self.register_buffer("coarse", torch.tensor(coarse))
        self.register_buffer("fine", torch.tensor(fine))
        self.posture = Posture(spec)

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Map positions [N, n] rad, velocities [N, n] rad/s and goals [N, 7] to observation and features.

        Returns:
            Observation [N, 2n + 12] and features [N, 7n + 12].
        """
        sine, cosine = torch.sin(joint_position), torch.cos(joint_position)
        linear, rotation, angular = self.kinematics.linearize_pose(cosine, sine)
        end_effector, jacobian = linear[:, :, -1], linear[:, :, :-1]
        wanted = quaternion_matrix(goal[:, 3:])
        error, turn = goal[:, :3] - end_effector, rotation_vector(rotation, wanted)
        shift = torch.bmm(error.unsqueeze(1), jacobian).squeeze(1)
        swing = torch.bmm(turn.unsqueeze(1), angular).squeeze(1)
        errors = torch.cat([error, turn, shift, swing], dim=1)
        wrapped, away = self.posture(joint_position, sine, cosine)
        columns = wanted[:, :, :2].transpose(1, 2).flatten(1)
        observation = torch.cat([wrapped, joint_velocity, end_effector, goal[:, :3], columns], dim=1)
        features = torch.cat([sine, cosine, away, errors * self.coarse, torch.tanh(errors * self.fine)], dim=1)
        return observation, features

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        """Map positions [N, n] rad and goals [N, 7] to distance, m, and angle, rad, of the end effector, [N, 2]."""
        linear, rotation, _ = self.kinematics.linearize_pose(torch.cos(joint_position), torch.sin(joint_position))
        distance = torch.linalg.vector_norm(linear[:, :, -1] - goal[:, :3], dim=1, keepdim=True)
        return torch.cat([distance, angle_between(rotation, quaternion_matrix(goal[:, 3:]))], dim=1)


class ReachPose(Reaching):
    """Goals are poses in space.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        region: Where goals lie: a :class:`physai.tasks.ReachableGoals`, partly made.
        tolerance: Distance that counts as reached, m.
        angle_tolerance: Angle that counts as reached, rad.
        angle_weight: What an angle costs in the reward, m/rad.
        **judging: How a step is judged, see :class:`Reaching`.
    """

    def __init__(
        self,
        spec: RobotSpec,
        kinematics: ForwardKinematics,
        region: Any,
        tolerance: PositiveFloat,
        angle_tolerance: PositiveFloat,
        angle_weight: PositiveFloat,
        **judging: Any,
    ) -> None:
        tolerances = Tolerance("distance", "m", tolerance), Tolerance("angle", "rad", angle_tolerance)
        super().__init__(spec, tolerances, (1.0, angle_weight), **judging)
        self._goals = goals_in(region, spec, kinematics, Quantity.POSE)
        self.region: Region = getattr(self._goals, "region", self._goals)
        low, high = (tuple(bound.tolist()) for bound in self.region.bounds)
        self.goal = Signal("goal", Quantity.POSE, (7,), low, high, ("x", "y", "z", "qx", "qy", "qz", "qw"), spec.base)
        self.module = ReachPoseObservation(spec, kinematics, tolerance, angle_tolerance)
        low, high = self.region.bounds
        seen = np.concatenate([low[:3], np.full(6, -1.0)]), np.concatenate([high[:3], np.ones(6)])
        self.observation = space_observation(spec, kinematics, seen)

    def sample_goal(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """See :class:`physai.tasks.Task`."""
        return self._goals.sample(rows, generator)
