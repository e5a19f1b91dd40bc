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
_REFINED = 3  # times
_TRIED = 3  # configurations a pose
_BETTER = 1e-3  # m², by which a later one must be: else rounding would choose between two that lead there
_UNKNOWN = 0.5  # m²/rad², the cost of leaving the ranges of the known ones
_ROOM = 0.05  # rad, to the joints' limits


class InverseKinematics(nn.Module):
    """Refines known configurations whose poses are nearest, and takes the best; scripts with ``torch.jit.script``.

    From wherever an arm is, following the way that shortens the error gets it stuck at its joint limits: many poses
    need another way to bend. A configuration that is known to lead near the pose has the right one. From there, steps
    of damped least squares (Nakamura and Hanafusa, 1986) lead to the pose. Of what they find, the one is taken that is
    best and within the ranges of the known configurations: where those keep away from touching anything, a wrist that
    is bent farther than in all of them may touch.

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
        self.arm, self.angular = _ARM, _ARM / math.sqrt(2.0)  # TorchScript knows no constants of modules
        self.refined, self.tried, self.unknown = _REFINED, _TRIED, _UNKNOWN
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
            "least": torch.from_numpy(configurations.min(axis=0)),
            "most": torch.from_numpy(configurations.max(axis=0)),
            "damping": _DAMPING * torch.eye(6),
            "later": _BETTER * torch.arange(_TRIED),
        }
        self.configurations: Tensor
        self.places: Tensor
        self.lengths: Tensor
        self.lower: Tensor
        self.upper: Tensor
        self.least: Tensor
        self.most: Tensor
        self.damping: Tensor
        self.later: Tensor
        for name, values in buffers.items():
            self.register_buffer(name, values.float())

    def forward(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Map positions [N, 3], m, and rotation matrices [N, 3, 3] to configurations, rad, [N, n]."""
        apart = torch.addmm(self.lengths, self._place(position, rotation), self.places, alpha=-2.0)
        found = self.configurations[apart.topk(self.tried, dim=1, largest=False)[1].flatten()]
        position = position.repeat_interleave(self.tried, dim=0)
        rotation = rotation.repeat_interleave(self.tried, dim=0)
        error, jacobian = self._linearize(found, position, rotation)
        for _ in range(self.refined):
            found = found + self.least_squares(jacobian, error)
            found = torch.maximum(torch.minimum(found, self.upper), self.lower)
            error, jacobian = self._linearize(found, position, rotation)
        outside = torch.relu(self.least - found) + torch.relu(found - self.most)
        worse = error.square().sum(dim=1) + self.unknown * outside.square().sum(dim=1)
        worse = worse.view(-1, self.tried) + self.later
        best = worse.argmin(dim=1, keepdim=True).unsqueeze(2)
        found = found.view(-1, self.tried, found.shape[1])
        return found.gather(1, best.expand(-1, 1, found.shape[2])).squeeze(1)

    def _linearize(self, joint_position: Tensor, position: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """Errors [N, 6], in m, and the Jacobian [N, 6, n] of what shortens them."""
        linear, turned, angular = self.kinematics.linearize_pose(torch.cos(joint_position), torch.sin(joint_position))
        error = torch.cat([position - linear[:, :, -1], self.arm * rotation_vector(turned, rotation)], dim=1)
        return error, torch.cat([linear[:, :, :-1], self.arm * angular], dim=1)

    @torch.jit.export
    def least_squares(self, jacobian: Tensor, error: Tensor) -> Tensor:
        """Map Jacobians [N, 6, n] and errors [N, 6] to the joints' way Jᵀ(JJᵀ + λ)⁻¹e, rad, [N, n].

        Solved by Gauss and Jordan's elimination, which all forms of a policy have; the damping spares it the pivoting.
        """
        square = torch.bmm(jacobian, jacobian.transpose(1, 2)) + self.damping
        rows = torch.cat([square, error.unsqueeze(2)], dim=2).permute(1, 2, 0).contiguous()  # [6, 7, N]
        for k in range(6):
            pivot = rows[k : k + 1] / rows[k, k]
            others = rows - rows[:, k : k + 1] * pivot
            rows = torch.cat([others[:k], pivot, others[k + 1 :]])
        return torch.bmm(rows[:, 6:].permute(2, 1, 0), jacobian).squeeze(1)

    def _place(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Poses as points, whose distance is that of the positions and of the angles."""
        return torch.cat([position, self.angular * rotation.flatten(1)], dim=1)
