"""Everything that makes one robot differ from the next, as one row of numbers per robot."""

import numpy as np
import torch
from torch import Tensor

from physai.physics.interface import DynamicsParameters, nominal_dynamics
from physai.robots import RobotSpec


class ParameterLayout:
    """Names and places of the columns of ``physics_parameters`` [N, P], absolute values in SI units.

    The dynamics of :data:`physai.physics.DynamicsParameters`, then ``actuator_delay`` (control steps, 1 column),
    ``encoder_offset`` (rad, one a joint), ``position_noise`` (rad, standard deviation, 1) and ``velocity_noise``
    (rad/s, standard deviation, 1).

    Attributes:
        columns: Name to slice.
        nominal: The robot of the URDF with perfect sensors and no delay, [P].
        labels: One readable name a column, such as ``link_mass[link1]``.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self._dynamics = nominal_dynamics(spec)
        rows = {
            **{name: value[0] for name, value in self._dynamics.items()},
            "actuator_delay": np.zeros(1),
            "encoder_offset": np.zeros(len(spec.joints)),
            "position_noise": np.zeros(1),
            "velocity_noise": np.zeros(1),
        }
        self.columns: dict[str, slice] = {}
        self.labels: list[str] = []
        start = 0
        for name, value in rows.items():
            self.columns[name] = slice(start, start + len(value))
            start += len(value)
            of = spec.moving_links if name == "link_mass" else spec.joints
            self.labels += [name] if len(value) == 1 else [f"{name}[{part}]" for part in of]
        self.nominal: Tensor = torch.from_numpy(np.concatenate(list(rows.values()))).float()

    def dynamics(self, parameters: np.ndarray) -> DynamicsParameters:
        """Split rows [r, P] into what the physics engine takes."""
        values = parameters.astype(np.float64)
        return {name: values[:, self.columns[name]] for name in self._dynamics}
