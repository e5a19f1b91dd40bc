"""Reach a pose: bring the end effector to a point in space, turned in a certain way."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from physai.config import PositiveFloat
from physai.robots import ForwardKinematics, RobotSpec, angle_between, quaternion_matrix, rotation_vector
from physai.signals import Quantity, Signal, Tolerance
from physai.tasks.interface import ObservationModule
from physai.tasks.reach_position import Posture, space_observation
from physai.tasks.reachable import made_reachable
from physai.tasks.reaching import Reaching

_KNOWN = 1024  # configurations in the policy file
_ARM = 0.3  # m/rad, by which angles count beside lengths
_DAMPING = 3e-3  # m²
_NEWTON = 13  # steps; by then the inverse is exact for what the damping leaves
_BENT = 0.02  # m², by which a pose may be farther whose configuration is nearer to home


class ReachPoseObservation(ObservationModule):
    """As :class:`physai.tasks.reach_position.ReachPositionObservation`, with what turns the end effector.

    The observation is ``[q, qd, ee, goal]``, where of a goal's orientation the first two columns of its rotation matrix
    are seen: they do not jump (Zhou et al., CVPR 2019), and are the same for a quaternion and its opposite. To the
    features come the rotation vector r from the end effector to the goal and J_ωᵀr, the direction in joint space that
    shortens it fastest; and the step that shortens both errors at once, by damped least squares (Nakamura and Hanafusa,
    1986).

    Following these alone, arms get stuck at their joint limits: many poses need another way to bend. So the module
    holds configurations and the poses that they lead to, and shows how far the joints are from the one whose pose is
    nearest to the goal: where roughly to go, whatever was before.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        tolerance: Distance that counts as reached, m.
        angle_tolerance: Angle that counts as reached, rad.
        known: Configurations [K, n], rad, and the poses that they lead to, [K, 7].
    """

    def __init__(
        self,
        spec: RobotSpec,
        kinematics: ForwardKinematics,
        tolerance: float,
        angle_tolerance: float,
        known: tuple[np.ndarray, np.ndarray],
    ) -> None:
        super().__init__()
        self.arm, self.angular, self.newton = _ARM, _ARM / math.sqrt(2.0), _NEWTON  # TorchScript knows no constants
        configurations, poses = (torch.from_numpy(array).float() for array in known)
        self.configurations: Tensor
        self.places: Tensor
        self.lengths: Tensor
        self.register_buffer("configurations", configurations)
        places = self._place(poses[:, :3], quaternion_matrix(poses[:, 3:]))
        self.register_buffer("places", places.T.contiguous())
        half = torch.from_numpy((spec.position_limit[:, 1] - spec.position_limit[:, 0]) / 2).float()
        bent = ((configurations - torch.from_numpy(spec.home).float()) / half).square().mean(dim=1)
        self.register_buffer("lengths", places.square().sum(dim=1) + _BENT * bent)
        self.kinematics = kinematics
        length, n = kinematics.reach, len(spec.joints)
        joints = [1.0 / (length * tolerance)] * n + [0.5 / angle_tolerance] * n
        coarse = [2.0 / length] * 3 + [1.0 / math.pi] * 3 + [0.25 * each for each in joints]
        fine = [0.5 / tolerance] * 3 + [0.5 / angle_tolerance] * 3 + joints
        self.coarse: Tensor
        self.fine: Tensor
        self.unit: Tensor
        self.twice: Tensor
        self.damping: Tensor
        self.register_buffer("unit", torch.eye(6))
        self.register_buffer("twice", 2.0 * torch.eye(6))
        self.register_buffer("damping", _DAMPING * torch.eye(6))
        self.register_buffer("coarse", torch.tensor(coarse))
        self.register_buffer("fine", torch.tensor(fine))
        self.posture = Posture(spec)

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Map positions [N, n] rad, velocities [N, n] rad/s and goals [N, 7] to observation and features.

        Returns:
            Observation [N, 2n + 12] and features [N, 11n + 12].
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
        way = self.nearest(goal[:, :3], wanted) - joint_position
        observation = torch.cat([wrapped, joint_velocity, end_effector, goal[:, :3], columns], dim=1)
        step = self.least_squares(
            torch.cat([jacobian, self.arm * angular], dim=1), torch.cat([error, self.arm * turn], dim=1)
        )
        bends = torch.cat([sine, cosine, away, way, torch.tanh(4.0 * way), step, torch.tanh(8.0 * step)], dim=1)
        features = torch.cat([bends, errors * self.coarse, torch.tanh(errors * self.fine)], dim=1)
        return observation, features

    @torch.jit.export
    def nearest(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Map positions [N, 3], m, and rotation matrices [N, 3, 3] to the configuration of the nearest pose, [N, n]."""
        apart = self.lengths - 2.0 * torch.matmul(self._place(position, rotation), self.places)
        return self.configurations[apart.argmin(dim=1)]

    def least_squares(self, jacobian: Tensor, error: Tensor) -> Tensor:
        """Map Jacobians [N, 6, n] and errors [N, 6] to the joints' way Jᵀ(JJᵀ + λ)⁻¹e, rad, [N, n].

        The inverse is found by Newton's method (Schulz, 1933): of products alone, which every form of a policy has.
        """
        square = torch.bmm(jacobian, jacobian.transpose(1, 2)) + self.damping
        inverse = self.unit / square.abs().sum(dim=2).amax(dim=1).unsqueeze(1).unsqueeze(2)
        for _ in range(self.newton):
            inverse = torch.bmm(inverse, self.twice - torch.bmm(square, inverse))
        return torch.bmm(torch.bmm(error.unsqueeze(1), inverse), jacobian).squeeze(1)

    def _place(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Poses as points, whose distance is that of the positions and of the angles."""
        return torch.cat([position, self.angular * rotation.flatten(1)], dim=1)

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
        known = self._goals.known(_KNOWN)
        self.module = ReachPoseObservation(spec, kinematics, tolerance, angle_tolerance, known)
        least, most = self.region.bounds
        seen = np.concatenate([least[:3], np.full(6, -1.0)]), np.concatenate([most[:3], np.ones(6)])
        self.observation = space_observation(spec, kinematics, seen)

    def sample_goal(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """See :class:`physai.tasks.Task`."""
        return self._goals.sample(rows, generator)

    @torch.no_grad()
    def rest(self, goal: np.ndarray) -> np.ndarray:
        """See :class:`Reaching`: the known configuration whose pose is nearest."""
        pose = torch.from_numpy(goal).float()
        return self.module.nearest(pose[:, :3], quaternion_matrix(pose[:, 3:])).double().numpy()
