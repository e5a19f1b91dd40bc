"""Sensors that are not perfect, between the robot and what its policy sees."""

from tensordict import TensorDictBase

from physai.physics import ImuErrors, ParameterLayout, SensorErrors
from physai.transforms.stochastic import StochasticTransform


class SensorModel(StochasticTransform):
    """Turns the true ``joint_position`` and ``joint_velocity`` [N, n] into what the robot's encoders report.

    Reward and success stay those of the true state.

    Args:
        layout: Of ``physics_parameters``.
        seed: Seeds the noise.
    """

    def __init__(self, layout: ParameterLayout, seed: int) -> None:
        keys = ["joint_position", "joint_velocity"]
        super().__init__(seed, in_keys=keys, out_keys=keys)
        self._errors = SensorErrors(layout)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        position, velocity = (next_tensordict.get(key) for key in self.in_keys)
        read = self._errors(position, velocity, next_tensordict.get("physics_parameters"), self.generator)
        for key, value in zip(self.out_keys, read, strict=True):
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)


class ImuModel(StochasticTransform):
    """Turns the true ``angular_velocity`` and ``gravity`` [N, 3] of a base that floats into what its IMU reports.

    Args:
        layout: Of ``physics_parameters``.
        seed: Seeds the noise.
    """

    def __init__(self, layout: ParameterLayout, seed: int) -> None:
        keys = ["angular_velocity", "gravity"]
        super().__init__(seed, in_keys=keys, out_keys=keys)
        self._errors = ImuErrors(layout)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        rates, gravity = (next_tensordict.get(key) for key in self.in_keys)
        read = self._errors(rates, gravity, next_tensordict.get("physics_parameters"), self.generator)
        for key, value in zip(self.out_keys, read, strict=True):
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)
