"""Inverse kinematics as a small torch module: a configuration that brings the end effector to a pose."""

import math

import numpy as np
import torch
from torch import Tensor, nn

from physai.robots.kinematics import ForwardKinematics, quaternion_matrix, rotation_vector
from physai.robots.spec import RobotSpec

_ARM = 0.3  # m/rad, by which angles count beside lengths
_BENT = 0.1  # m², by which a pose may be farther whose configuration is nearer to home
_DAMPING = 3e-3  # m²
_NEWTON = 13  # steps; by then the inverse is exact for what the damping leaves
_REFINED = 3  # times
_ROOM = 0.05  # rad, to the joints' limits


class InverseKinematics(nn.Module):
    """Finds the known configuration whose pose is nearest, and refines it; scripts with ``torch.jit.script``.

    From wherever an arm is, following the way that shortens the error gets it stuck at its joint limits: many poses
    need another way to bend. A configuration that is known to lead near the pose has the right one. From there, steps
    of damped least squares (Nakamura and Hanafusa, 1986) lead to the pose.

    What it finds follows from the pose alone: an arm that is sent there twice bends the same way twice.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        configurations: Known ones, rad, [K, n].
        poses: Where they lead, position in m and quaternion x, y, z, w, [K, 7].
    """

    def __init__(
        self, spec: RobotSpec, kinematics: ForwardKinematics, configurations: np.ndarray, poses: np.ndarray
    ) -> None:
        super().__init__()
        # TorchScript knows no constants of modules.
        self.arm, self.angular, self.newton, self.refined = _ARM, _ARM / math.sqrt(2.0), _NEWTON, _REFINED
        self.kinematics = kinematics
        lower, upper = spec.position_limit.T
        bent = np.square((configurations - spec.home) / ((upper - lower) / 2)).mean(axis=1)
        known = torch.from_numpy(poses).float()
        places = self._place(known[:, :3], quaternion_matrix(known[:, 3:]))
        buffers = {
            "configurations": torch.from_numpy(configurations),
            "places": places.T.contiguous(),
            "lengths": places.square().sum(dim=1) + _BENT * torch.from_numpy(bent),
            "lower": torch.from_numpy(lower + _ROOM),
            "upper": torch.from_numpy(upper - _ROOM),
            "twice": 2.0 * torch.eye(6),
            "damping": _DAMPING * torch.eye(6),
        }
        self.configurations: Tensor
        self.places: Tensor
        self.lengths: Tensor
        self.lower: Tensor
        self.upper: Tensor
        self.twice: Tensor
        self.damping: Tensor
        for name, values in buffers.items():
            self.register_buffer(name, values.float())

    def forward(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Map positions [N, 3], m, and rotation matrices [N, 3, 3] to configurations, rad, [N, n]."""
        apart = self.lengths - 2.0 * torch.matmul(self._place(position, rotation), self.places)
        found = self.configurations[apart.argmin(dim=1)]
        for _ in range(self.refined):
            linear, turned, angular = self.kinematics.linearize_pose(torch.cos(found), torch.sin(found))
            jacobian = torch.cat([linear[:, :, :-1], self.arm * angular], dim=1)
            error = torch.cat([position - linear[:, :, -1], self.arm * rotation_vector(turned, rotation)], dim=1)
            found = found + self.least_squares(jacobian, error)
            found = torch.maximum(torch.minimum(found, self.upper), self.lower)
        return found

    @torch.jit.export
    def least_squares(self, jacobian: Tensor, error: Tensor) -> Tensor:
        """Map Jacobians [N, 6, n] and errors [N, 6] to the joints' way Jᵀ(JJᵀ + λ)⁻¹e, rad, [N, n].

        The inverse is found by Newton's method (Schulz, 1933): of products alone, which every form of a policy has.
        """
        square = torch.bmm(jacobian, jacobian.transpose(1, 2)) + self.damping
        inverse = 0.5 * self.twice / square.abs().sum(dim=2).amax(dim=1).unsqueeze(1).unsqueeze(2)
        for _ in range(self.newton):
            inverse = torch.bmm(inverse, self.twice - torch.bmm(square, inverse))
        return torch.bmm(torch.bmm(error.unsqueeze(1), inverse), jacobian).squeeze(1)

    def _place(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Poses as points, whose distance is that of the positions and of the angles."""
        return torch.cat([position, self.angular * rotation.flatten(1)], dim=1)
