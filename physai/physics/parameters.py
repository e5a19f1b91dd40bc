"""Everything that makes one robot differ from the next, as one row of numbers per robot."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from physai.physics.interface import DynamicsParameters, nominal_dynamics
from physai.robots import RobotSpec

# By how much robots differ in what their description says is zero: kg, Nms/rad, Nm, kg m², m, control steps, rad, rad,
# rad/s, rad/s, a share of 9.81 m/s², m/s.
_USUAL = {
    "payload": 0.5,
    "joint_damping": 0.1,
    "joint_friction": 0.1,
    "armature": 0.01,
    "center_of_mass": 0.02,
    "actuator_delay": 1.0,
    "encoder_offset": 0.01,
    "position_noise": 0.005,
    "velocity_noise": 0.1,
    "gyro_noise": 0.1,
    "gravity_noise": 0.02,
    "push": 0.5,
}


class ParameterLayout:
    """Names and places of the columns of ``physics_parameters`` [N, P], absolute values in SI units.

    The dynamics of :data:`physai.physics.DynamicsParameters`, then ``actuator_delay`` (control steps, 1 column),
    ``encoder_offset`` (rad, one a joint), ``position_noise`` (rad, standard deviation, 1) and ``velocity_noise``
    (rad/s, standard deviation, 1). Where the base floats, they are followed by ``gyro_noise`` (rad/s) and
    ``gravity_noise`` (of a direction of length 1) of its IMU, standard deviations, and ``push`` (m/s): by how much the
    base's velocity jumps now and then.

    Args:
        spec: The robot.
        ignored: Dynamics that its engine leaves as described (:attr:`physai.physics.Physics.ignores`).

    Attributes:
        columns: Name to slice.
        ignored: As given.
        nominal: The robot of the URDF with perfect sensors and no delay, [P].
        labels: One readable name a column, such as ``link_mass[link1]``.
    """

    def __init__(self, spec: RobotSpec, ignored: Sequence[str] = ()) -> None:
        self.ignored = tuple(ignored)
        self._dynamics = nominal_dynamics(spec)
        rows = {
            **{name: value[0] for name, value in self._dynamics.items()},
            "actuator_delay": np.zeros(1),
            "encoder_offset": np.zeros(len(spec.joints)),
            "position_noise": np.zeros(1),
            "velocity_noise": np.zeros(1),
        }
        if spec.floating is not None:
            rows |= {name: np.zeros(1) for name in ("gyro_noise", "gravity_noise", "push")}
        self.columns: dict[str, slice] = {}
        self.labels: list[str] = []
        start = 0
        for name, value in rows.items():
            self.columns[name] = slice(start, start + len(value))
            start += len(value)
            parts = {"link_mass": spec.moving_links, "center_of_mass": ("x", "y", "z")}.get(name, spec.joints)
            self.labels += [name] if len(value) == 1 else [f"{name}[{part}]" for part in parts]
        self.nominal: Tensor = torch.from_numpy(np.concatenate(list(rows.values()))).float()
        usual = np.concatenate([np.full(len(value), _USUAL.get(name, 1.0)) for name, value in rows.items()])
        self._scale = np.where(self.nominal.numpy() > 0, self.nominal.numpy(), usual).astype(np.float32)

    def relative(self, parameters: np.ndarray) -> np.ndarray:
        """Parameters [N, P] as a network likes to see them: zero is the nominal robot, 1 is twice what it has there.

        What is zero in the nominal robot is measured in what robots usually have.
        """
        return (parameters - self.nominal.numpy()) / self._scale

    def dynamics(self, parameters: np.ndarray, per_control_step: float = 1.0) -> DynamicsParameters:
        """Split rows [r, P] into what the physics engine takes.

        Args:
            parameters: Rows of ``physics_parameters``; their gains are of the env's control period.
            per_control_step: How many periods of the engine make one of the env: where they are shorter, a motor of
                the same time constant makes up for a smaller share of the missing velocity in each.
        """
        values = parameters.astype(np.float64)
        dynamics = {name: values[:, self.columns[name]] for name in self._dynamics}
        if "velocity_gain" in dynamics:
            gain = np.minimum(dynamics["velocity_gain"], 1.0)
            dynamics["velocity_gain"] = gain / (gain + per_control_step * (1.0 - gain))
        return dynamics
