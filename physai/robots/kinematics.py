"""Forward kinematics as a small torch module: one implementation for simulation, policy and robot."""

import math

import numpy as np
import torch
from torch import Tensor, nn

from physai.robots.chain import axis_of
from physai.robots.spec import RobotSpec


class ForwardKinematics(nn.Module):
    """Where the end effector is in the robot's base frame; scripts with ``torch.jit.script``.

    By Rodrigues' formula, what a joint does to points of the link behind it is ``M(q) = A + B cos(q) + C sin(q)``,
    with three constant 4 x 4 matrices that also hold the fixed transform before the joint and the joints that are held
    at zero. The tip is carried through them from the last joint to the base. The derivative
    ``dM/dq = C cos(q) - B sin(q)`` is stacked below M, so that one product a joint gives position and slopes.

    Args:
        spec: The robot; its joints that are not controlled count as held at zero.

    Attributes:
        shoulder: Where the first controlled joint is in the base frame, m, [3].
        reach: Length of the stretched arm from there to the tip, m; no point beyond it can be reached.
    """

    def __init__(self, spec: RobotSpec) -> None:
        super().__init__()
        motion, fixed = spec.motions, spec.tip
        assert fixed is not None, f"'{spec.name}' has no end effector"
        offsets = motion.constant[:, :3, 3].copy()
        constant, cosine, sine = np.zeros((3, len(motion), 8, 4))
        constant[:, :4] = motion.constant
        cosine[:, :4] = sine[:, 4:] = motion.cosine
        sine[:, :4] = cosine[:, 4:] = motion.sine
        sine[:, 4:] *= -1
        axes = np.array([axis_of(joint) for joint in spec.linkage if joint.name in spec.joints])
        for matrix in (constant, cosine, sine):
            matrix[-1] = matrix[-1] @ fixed  # the last link's frame moves to the tip
        axes[-1] = fixed[:3, :3].T @ axes[-1]
        self.shoulder = offsets[0].copy()
        self.reach = float(sum(np.linalg.norm(offset) for offset in offsets[1:]) + np.linalg.norm(fixed[:3, 3]))
        self.constant: Tensor
        self.cosine: Tensor
        self.sine: Tensor
        self.register_buffer("constant", torch.from_numpy(constant).float())  # [n, 8, 4]
        self.register_buffer("cosine", torch.from_numpy(cosine).float())  # [n, 8, 4]
        self.register_buffer("sine", torch.from_numpy(sine).float())  # [n, 8, 4]
        self.axes: Tensor
        self.register_buffer("axes", torch.from_numpy(axes).float())  # [n, 3], in the frame of the link behind

    def forward(self, joint_position: Tensor) -> Tensor:
        """Map joint positions [N, n] in rad to end-effector positions [N, 3] in m."""
        return self.linearize(torch.cos(joint_position), torch.sin(joint_position))[:, :, -1]

    @torch.jit.export
    def linearize(self, cosine: Tensor, sine: Tensor) -> Tensor:
        """Map cosines and sines of joint positions, [N, n] each, to position and slopes.

        Returns:
            [N, 3, n + 1]: the Jacobian in m/rad, then the end effector in m.
        """
        return self._linearize(self._motion(cosine, sine))

    @torch.jit.export
    def linearize_pose(self, cosine: Tensor, sine: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map cosines and sines of joint positions, [N, n] each, to pose and slopes.

        Returns:
            What ``linearize`` does, [N, 3, n + 1]; the end effector's rotation matrix, [N, 3, 3]; and its angular
            Jacobian in the base frame, [N, 3, n]: the lower half of the geometric Jacobian.
        """
        motion = self._motion(cosine, sine)
        rotation = motion[:, 0, :3, :3]
        turning = [torch.matmul(rotation, self.axes[0])]
        for joint in range(1, motion.shape[1]):
            rotation = torch.bmm(rotation, motion[:, joint, :3, :3])
            turning.append(torch.matmul(rotation, self.axes[joint]))
        return self._linearize(motion), rotation, torch.stack(turning, dim=2)

    def _motion(self, cosine: Tensor, sine: Tensor) -> Tensor:
        cosine, sine = cosine.unsqueeze(-1).unsqueeze(-1), sine.unsqueeze(-1).unsqueeze(-1)
        return torch.addcmul(torch.addcmul(self.constant, self.cosine, cosine), self.sine, sine)  # [N, n, 8, 4]

    def _linearize(self, motion: Tensor) -> Tensor:
        last = motion.shape[1] - 1
        columns = torch.stack([motion[:, last, 4:, 3], motion[:, last, :4, 3]], dim=2)
        for joint in range(last - 1, -1, -1):
            moved = torch.bmm(motion[:, joint], columns)  # [N, 8, slopes of the joints so far + 1]
            columns = torch.cat([moved[:, 4:, -1:], moved[:, :4]], dim=2)
        return columns[:, :3]


def quaternion_matrix(quaternion: Tensor) -> Tensor:
    """Map quaternions x, y, z, w [N, 4] of any length but zero to rotation matrices [N, 3, 3]."""
    q = quaternion / torch.linalg.vector_norm(quaternion, dim=1, keepdim=True).clamp(min=1e-9)
    x, y, z, w = q[:, 0], q[:, 1], q[:, 2], q[:, 3]
    first = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
    second = [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
    third = [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    return torch.stack(first + second + third, dim=1).view(-1, 3, 3)


def rotation_vector(start: Tensor, end: Tensor) -> Tensor:
    """Return the turn that takes rotation matrices ``start`` to ``end``, [N, 3, 3] each: axis times angle, rad, [N, 3].

    At half a turn the axis may as well be its opposite. From 0.025 rad before on, the vector is shorter, down to zero
    there: so it jumps nowhere.
    """
    turn = torch.bmm(end, start.transpose(1, 2))
    axis = torch.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], dim=1
    )
    angle, length = angle_between(start, end), torch.linalg.vector_norm(axis, dim=1, keepdim=True)  # 2 sin(angle)
    return axis * angle / torch.where(angle > 3.0, length.clamp(min=0.05), length.clamp(min=1e-9))


def angle_between(start: Tensor, end: Tensor) -> Tensor:
    """Return the angle between rotation matrices [N, 3, 3], rad, [N, 1]; exact for small ones, too."""
    # |R1 - R2|² = 8 sin²(θ/2), and the trace of R1ᵀR2 is 4 cos²(θ/2) - 1.
    sine = torch.linalg.vector_norm((end - start).flatten(1), dim=1) / 8**0.5
    cosine = torch.sqrt(((start * end).flatten(1).sum(dim=1) + 1.0).clamp(min=0.0)) / 2
    return 2 * torch.atan2(sine, cosine).unsqueeze(1)


class EndEffector:
    """Where the end effectors of many robots are, as :class:`ForwardKinematics` says, without torch.

    At every step of a simulation, calling torch costs more than what it computes. The matrices are those of the module;
    only their product is written again: in arrays for many robots, and in plain numbers for one, where NumPy's calls
    cost more than what they compute, too.

    Args:
        kinematics: The module.
    """

    def __init__(self, kinematics: ForwardKinematics) -> None:
        terms = [kinematics.constant, kinematics.cosine, kinematics.sine]
        # Joint by joint [4, 3 terms, 4]: what each term makes of a point [x, y, z, 1].
        motions = np.stack([term[:, :4].double().numpy() for term in terms], axis=2)
        *before, last = motions
        self._joints = [np.ascontiguousarray(joint) for joint in before[::-1]]  # from the tip to the base
        self._tip = last[:, :, 3].copy()  # [4, 3 terms]: the tip is the origin of the last link's frame
        self._tip_numbers = self._tip[:3].tolist()
        self._joint_numbers = [  # turning moves no origin
            [(*constant, *cosine[:3], *sine[:3]) for constant, cosine, sine in joint[:3].tolist()]
            for joint in self._joints
        ]

    def __call__(self, joint_position: np.ndarray) -> np.ndarray:
        """Map joint positions [N, n], rad, to positions in the base frame [N, 3], m."""
        if len(joint_position) == 1:
            return np.array([self._of_one(joint_position[0].tolist())])
        terms = np.empty((joint_position.shape[1], 3, len(joint_position)))
        terms[:, 0] = 1.0
        np.cos(joint_position.T, out=terms[:, 1])
        np.sin(joint_position.T, out=terms[:, 2])
        # einsum adds up in the same order for any number of robots, which matrix products do not.
        point = np.einsum("it,tk->ik", self._tip, terms[-1])
        for motion, turned in zip(self._joints, terms[-2::-1], strict=True):
            point = np.einsum("itj,tk,jk->ik", motion, turned, point)
        return np.ascontiguousarray(point[:3].T)

    def _of_one(self, joint_position: list[float]) -> list[float]:
        c, s = math.cos(joint_position[-1]), math.sin(joint_position[-1])
        point = [a + b * c + d * s for a, b, d in self._tip_numbers]
        for angle, rows in zip(joint_position[-2::-1], self._joint_numbers, strict=True):
            x, y, z = point
            c, s = math.cos(angle), math.sin(angle)
            point = [
                at + ax * x + ay * y + az * z + (bx * x + by * y + bz * z) * c + (cx * x + cy * y + cz * z) * s
                for ax, ay, az, at, bx, by, bz, cx, cy, cz in rows
            ]
        return point
