"""Sensors that are not perfect: encoders with an offset, noise on what they and an IMU read."""

import torch
from torch import Tensor

from physai.physics.parameters import ParameterLayout


class SensorErrors:
    """What encoders report of the true joint state; for simulated robots as for a virtual one behind ROS topics.

    Args:
        layout: Tells where ``encoder_offset``, ``position_noise`` and ``velocity_noise`` stand in
            ``physics_parameters``.
    """

    def __init__(self, layout: ParameterLayout) -> None:
        self._offset, self._position_noise, self._velocity_noise = (
            layout.columns[name] for name in ("encoder_offset", "position_noise", "velocity_noise")
        )

    def __call__(
        self, joint_position: Tensor, joint_velocity: Tensor, parameters: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Map true positions, rad, and velocities, rad/s, [N, n], of robots with ``parameters`` [N, P] to readings."""
        noise = torch.randn(2, *joint_position.shape, generator=generator, dtype=joint_position.dtype)
        position = torch.addcmul(
            joint_position + parameters[:, self._offset], parameters[:, self._position_noise], noise[0]
        )
        return position, torch.addcmul(joint_velocity, parameters[:, self._velocity_noise], noise[1])


class ImuErrors:
    """What an IMU reports of the true angular velocity and direction of gravity.

    Args:
        layout: Tells where ``gyro_noise`` and ``gravity_noise`` stand in ``physics_parameters``.
    """

    def __init__(self, layout: ParameterLayout) -> None:
        self._noise = [layout.columns[name] for name in ("gyro_noise", "gravity_noise")]

    def __call__(
        self, angular_velocity: Tensor, gravity: Tensor, parameters: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Map angular velocities, rad/s, and directions of gravity, [N, 3] each, to readings."""
        noise = torch.randn(2, *gravity.shape, generator=generator, dtype=gravity.dtype)
        gyro, direction = (parameters[:, columns] for columns in self._noise)
        turned = torch.addcmul(gravity, direction, noise[1])
        length = torch.linalg.vector_norm(turned, dim=1, keepdim=True).clamp(min=1e-6)
        return torch.addcmul(angular_velocity, gyro, noise[0]), turned / length
