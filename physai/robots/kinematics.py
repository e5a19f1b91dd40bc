"""Forward kinematics as a small torch module: one implementation for simulation, policy and robot."""

import numpy as np
import torch
from torch import Tensor, nn

from physai.robots.spec import RobotSpec


class ForwardKinematics(nn.Module):
    """Position of the end effector in the robot's base frame; scripts with ``torch.jit.script``.

    The tip is carried from the last joint to the base. One joint turns a point p by Rodrigues' formula,
    ``R(q) p = (I - P) p cos(q) + K p sin(q) + P p``, with K the cross-product matrix of the axis and P the projection
    onto it; the three matrices, the fixed rotation before the joint, and joints that are held at zero are multiplied
    out once, so that a joint costs one matrix product.

    Args:
        spec: The robot; its joints that are not controlled count as held at zero.

    Attributes:
        reach: Length of the stretched arm from its first controlled joint to the tip, m; no point beyond it can be
            reached.
    """

    def __init__(self, spec: RobotSpec) -> None:
        super().__init__()
        rotations, offsets = [], []
        fixed = np.eye(4)
        for joint in spec.chain:
            fixed = fixed @ (np.eye(4) if joint.origin is None else joint.origin)
            if joint.name not in spec.joints:
                continue
            x, y, z = joint.axis / np.linalg.norm(joint.axis)
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            along = np.outer([x, y, z], [x, y, z])
            before = fixed[:3, :3]
            rotations.append(np.vstack([before @ (np.eye(3) - along), before @ cross, before @ along]).T)
            offsets.append(fixed[:3, 3])
            fixed = np.eye(4)
        self.reach = float(sum(np.linalg.norm(offset) for offset in offsets[1:]) + np.linalg.norm(fixed[:3, 3]))
        self.rotations: Tensor
        self.offsets: Tensor
        self.tip: Tensor
        self.register_buffer("rotations", torch.tensor(np.array(rotations), dtype=torch.float32))  # [n, 3, 9]
        self.register_buffer("offsets", torch.tensor(np.array(offsets), dtype=torch.float32))  # [n, 3]
        self.register_buffer("tip", torch.tensor(fixed[:3, 3], dtype=torch.float32))  # [3]

    def forward(self, joint_position: Tensor) -> Tensor:
        """Map joint positions [..., n] in rad to end-effector positions [..., 3] in m."""
        cosine, sine = torch.cos(joint_position), torch.sin(joint_position)
        point = self.tip
        for joint in range(self.rotations.shape[0] - 1, -1, -1):
            across, cross, along = torch.matmul(point, self.rotations[joint]).split(3, dim=-1)
            point = along + self.offsets[joint]
            point = torch.addcmul(point, across, cosine[..., joint : joint + 1])
            point = torch.addcmul(point, cross, sine[..., joint : joint + 1])
        return point

    @torch.jit.export
    def linearize(self, joint_position: Tensor) -> Tensor:
        """Map joint positions [..., n] in rad to [..., 1 + n, 3]: the end effector p in m, then dp/dq in m/rad."""
        cosine, sine = torch.cos(joint_position)[..., None], torch.sin(joint_position)[..., None]
        vectors = self.tip.expand(joint_position.shape[:-1] + (1, 3))  # noqa: RUF005 (TorchScript knows no unpacking here)
        for joint in range(self.rotations.shape[0] - 1, -1, -1):
            across, cross, along = torch.matmul(vectors, self.rotations[joint]).split(3, dim=-1)
            c, s = cosine[..., joint : joint + 1, :], sine[..., joint : joint + 1, :]
            slope = cross[..., :1, :] * c - across[..., :1, :] * s
            turned = torch.addcmul(torch.addcmul(along, across, c), cross, s)
            # Only the point moves with the offset; slopes are directions.
            vectors = torch.cat([turned[..., :1, :] + self.offsets[joint], slope, turned[..., 1:, :]], dim=-2)
        return vectors
