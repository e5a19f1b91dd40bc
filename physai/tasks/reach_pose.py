"""Reach a pose: bring the end effector to a point in space, turned in a certain way."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from physai.config import PositiveFloat
from physai.robots import (
    ForwardKinematics,
    InverseKinematics,
    RobotSpec,
    angle_between,
    quaternion_matrix,
    rotation_vector,
)
from physai.signals import Quantity, Signal, Tolerance
from physai.tasks.interface import ObservationModule
from physai.tasks.reach_position import Posture, space_observation
from physai.tasks.reachable import made_reachable
from physai.tasks.reaching import Reaching

_KNOWN = 4096  # configurations in the policy file
_GAIN = 5.0  # 1/s, by which the way to a configuration becomes a speed
_ARCH = 0.5  # of the way from a far configuration to home, by which an arm's way there is bent
_FAR = 2.0  # rad, which counts as far
_HOMEWARD = 3.0  # rad, the most that counts of the way home; from 4 on, an arm could come to rest on its way
_MOST = 1.5  # latent action of the joint with the longest way: 91 % of its largest command


class ReachPoseObservation(ObservationModule):
    """As :class:`physai.tasks.reach_position.ReachPositionObservation`, with what turns the end effector.

    The observation is ``[q, qd, ee, goal]``, where of a goal's orientation the first two columns of its rotation matrix
    are seen: they do not jump (Zhou et al., CVPR 2019), and are the same for a quaternion and its opposite. To the
    features come the rotation vector r from the end effector to the goal and J_ωᵀr, the direction in joint space that
    shortens it fastest; and the way to a configuration that leads there, which inverse kinematics find. It suggests to
    go to that, as a controller without learning would: in an arch that a far way bends towards home, where an arm
    keeps clear of itself and of the floor. Going straight, more than twice as many ways touch something.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        inverse: Its inverse kinematics.
        tolerance: Distance that counts as reached, m.
        angle_tolerance: Angle that counts as reached, rad.
    """

    suggests = True

    def __init__(
        self,
        spec: RobotSpec,
        kinematics: ForwardKinematics,
        inverse: InverseKinematics,
        tolerance: float,
        angle_tolerance: float,
    ) -> None:
        super().__init__()
        self.kinematics, self.inverse = kinematics, inverse
        self.most, self.arch, self.far = _MOST, _ARCH, _FAR  # TorchScript knows no constants of modules
        self.homeward = _HOMEWARD
        length, n = kinematics.reach, len(spec.joints)
        joints = [1.0 / (length * tolerance)] * n + [0.5 / angle_tolerance] * n
        coarse = [2.0 / length] * 3 + [1.0 / math.pi] * 3 + [0.25 * each for each in joints]
        fine = [0.5 / tolerance] * 3 + [0.5 / angle_tolerance] * 3 + joints
        self.coarse: Tensor
        self.fine: Tensor
        self.gain: Tensor
        self.register_buffer("coarse", torch.tensor(coarse))
        self.register_buffer("fine", torch.tensor(fine))
        self.register_buffer("gain", torch.from_numpy(_GAIN / spec.command_limit).float())
        self.home: Tensor
        self.register_buffer("home", torch.from_numpy(spec.home).float())
        self.posture = Posture(spec)

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Map positions [N, n] rad, velocities [N, n] rad/s and goals [N, 7] to observation and features.

        Returns:
            Observation [N, 2n + 12] and features [N, 10n + 12].
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
        there = self.inverse(goal[:, :3], wanted)
        way = there - joint_position
        observation = torch.cat([wrapped, joint_velocity, end_effector, goal[:, :3], columns], dim=1)
        errors = torch.cat([errors * self.coarse, torch.tanh(errors * self.fine)], dim=1)
        bends = torch.cat([sine, cosine, away, way, torch.tanh(4.0 * way)], dim=1)
        return observation, torch.cat([bends, errors, self._suggest(way, there)], dim=1)

    def _suggest(self, way: Tensor, there: Tensor) -> Tensor:
        """Map ways of joints to a configuration, rad, [N, n] each, to latent actions [N, n].

        The joint with the longest way sets the time. The arch is always shorter than that way: there is no place to
        rest at but the configuration.
        """
        far = (way.abs().amax(dim=1, keepdim=True) / self.far).clamp(max=1.0)
        homeward = (self.home - there).clamp(-self.homeward, self.homeward)
        speed = (way + self.arch * far.square() * homeward) * self.gain
        return speed / (speed.abs().amax(dim=1, keepdim=True) / self.most).clamp(min=1.0)

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
        region: Where goals lie: :class:`physai.tasks.ReachableGoals`, partly made.
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
        self._goals = made_reachable(region, spec, kinematics, Quantity.POSE, self.surroundings)
        self.region = self._goals.region
        low, high = (tuple(bound.tolist()) for bound in self.region.bounds)
        self.goal = Signal("goal", Quantity.POSE, (7,), low, high, ("x", "y", "z", "qx", "qy", "qz", "qw"), spec.base)
        inverse = InverseKinematics(spec, kinematics, *self._goals.known(_KNOWN))
        self.module = ReachPoseObservation(spec, kinematics, inverse, tolerance, angle_tolerance)
        least, most = self.region.bounds
        seen = np.concatenate([least[:3], np.full(6, -1.0)]), np.concatenate([most[:3], np.ones(6)])
        self.observation = space_observation(spec, kinematics, seen)

    def sample_goal(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """See :class:`physai.tasks.Task`."""
        return self._goals.sample(rows, generator)
