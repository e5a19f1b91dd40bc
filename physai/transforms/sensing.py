"""Sensors that are not perfect: encoders with an offset, noise on what they read."""

import torch
from tensordict import TensorDictBase

from physai.physics import ParameterLayout
from physai.transforms.stochastic import StochasticTransform


class SensorModel(StochasticTransform):
    """Turns the true ``joint_position`` and ``joint_velocity`` [N, n] into what the robot's encoders report.

    Reward and success stay those of the true state.

    Args:
        layout: Tells where ``encoder_offset``, ``position_noise`` and ``velocity_noise`` stand in
            ``physics_parameters``.
        seed: Seeds the noise.
    """

    def __init__(self, layout: ParameterLayout, seed: int) -> None:
        keys = ["joint_position", "joint_velocity"]
        super().__init__(seed, in_keys=keys, out_keys=keys)
        self._offset, self._position_noise, self._velocity_noise = (
            layout.columns[name] for name in ("encoder_offset", "position_noise", "velocity_noise")
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        parameters = next_tensordict.get("physics_parameters")
        position, velocity = next_tensordict.get("joint_position"), next_tensordict.get("joint_velocity")
        noise = torch.randn(2, *position.shape, generator=self.generator)
        position = torch.addcmul(position + parameters[:, self._offset], parameters[:, self._position_noise], noise[0])
        velocity = torch.addcmul(velocity, parameters[:, self._velocity_noise], noise[1])
        return next_tensordict.set("joint_position", position).set("joint_velocity", velocity)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)
