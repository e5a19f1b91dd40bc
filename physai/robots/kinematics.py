"""Forward kinematics as a small torch module: one implementation for simulation, policy and robot."""

import numpy as np
import torch
from torch import Tensor, nn

from physai.robots.spec import RobotSpec


class ForwardKinematics(nn.Module):
    """Position of the end effector in the robot's base frame; scripts with ``torch.jit.script``.

    By Rodrigues' formula, what a joint does to points of the link behind it is ``M(q) = A + B cos(q) + C sin(q)``,
    with three constant 4 x 4 matrices that also hold the fixed transform before the joint and the joints that are held
    at zero. The tip is carried through them from the last joint to the base. The derivative
    ``dM/dq = C cos(q) - B sin(q)`` is stacked below M, so that one product a joint gives position and slopes.

    Args:
        spec: The robot; its joints that are not controlled count as held at zero.

    Attributes:
        reach: Length of the stretched arm from its first controlled joint to the tip, m; no point beyond it can be
            reached.
    """

    def __init__(self, spec: RobotSpec) -> None:
        super().__init__()
        constant, cosine, sine = (np.zeros((len(spec.joints), 8, 4)) for _ in range(3))
        offsets: list[np.ndarray] = []
        fixed = np.eye(4)
        for joint in spec.chain:
            fixed = fixed @ (np.eye(4) if joint.origin is None else joint.origin)
            if joint.name not in spec.joints:
                continue
            x, y, z = joint.axis / np.linalg.norm(joint.axis)
            along = np.outer([x, y, z], [x, y, z])
            across = np.eye(3) - along
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            row = len(offsets)
            constant[row, :4] = fixed
            constant[row, :3, :3] = fixed[:3, :3] @ along
            cosine[row, :3, :3] = sine[row, 4:7, :3] = fixed[:3, :3] @ across
            sine[row, :3, :3] = cosine[row, 4:7, :3] = fixed[:3, :3] @ cross
            sine[row, 4:7] *= -1
            offsets.append(fixed[:3, 3])
            fixed = np.eye(4)
        for matrix in (constant, cosine, sine):
            matrix[-1] = matrix[-1] @ fixed  # the last link's frame moves to the tip
        self.reach = float(sum(np.linalg.norm(offset) for offset in offsets[1:]) + np.linalg.norm(fixed[:3, 3]))
        self.constant: Tensor
        self.cosine: Tensor
        self.sine: Tensor
        self.register_buffer("constant", torch.from_numpy(constant).float())  # [n, 8, 4]
        self.register_buffer("cosine", torch.from_numpy(cosine).float())  # [n, 8, 4]
        self.register_buffer("sine", torch.from_numpy(sine).float())  # [n, 8, 4]

    def forward(self, joint_position: Tensor) -> Tensor:
        """Map joint positions [N, n] in rad to end-effector positions [N, 3] in m."""
        motions = self._motions(joint_position)
        point = motions[-1].narrow(1, 0, 4).narrow(2, 3, 1)
        for motion in motions[-2::-1]:
            point = torch.bmm(motion.narrow(1, 0, 4), point)
        return point.narrow(1, 0, 3).squeeze(2)

    @torch.jit.export
    def linearize(self, joint_position: Tensor) -> Tensor:
        """Map joint positions [N, n] in rad to [N, 3, n + 1]: the Jacobian in m/rad, then the end effector in m."""
        motions = self._motions(joint_position)
        point, slope = motions[-1].narrow(2, 3, 1).split(4, dim=1)
        columns = torch.cat([slope, point], dim=2)  # [N, 4, slopes of the joints so far + 1]
        for motion in motions[-2::-1]:
            moved, slopes = torch.bmm(motion, columns).split(4, dim=1)
            columns = torch.cat([slopes.narrow(2, -1, 1), moved], dim=2)
        return columns.narrow(1, 0, 3)

    def _motions(self, joint_position: Tensor) -> list[Tensor]:
        """M and its derivative for each joint: n of [N, 8, 4]."""
        angle = joint_position.unsqueeze(-1).unsqueeze(-1)
        motion = torch.addcmul(self.constant, self.cosine, torch.cos(angle))
        return list(torch.addcmul(motion, self.sine, torch.sin(angle)).unbind(1))
