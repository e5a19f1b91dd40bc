"""The numbers of a robot that are to be found, as coordinates in which all of them are of size one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physai.config import nearest
from physai.errors import UserError
from physai.physics import ParameterLayout
from physai.robots import RobotSpec

FITTED = (
    "link_mass",
    "payload",
    "joint_damping",
    "joint_friction",
    "effort_limit",
    "armature",
    "velocity_gain",
    "encoder_offset",
)
_IN_PARTS = ("link_mass", "joint_damping", "effort_limit")  # found as a factor of the description; one unit is e
_PAYLOAD, _OFFSET, _GAIN = 0.3, 0.02, 0.3  # kg, rad, 1: one unit of theirs
_FRICTION = 0.05  # of the effort limit: one unit of friction
_ARMATURE = 0.01  # kg·m² for each N·m of the effort limit: one unit of a rotor's inertia
_FARTHEST = 4.0  # units


@dataclass(frozen=True)
class Unknowns:
    """Which columns of ``physics_parameters`` are to be found, F of them.

    A coordinate is 0 where the robot is as described. One unit is as far as it may well be from that, before anything
    was measured.

    Attributes:
        labels: A name for each, such as ``link_mass[link1]``.
        columns: Where they stand, [F].
        low: Smallest coordinates, [F].
        high: Largest, [F].
        in_parts: Which are factors of the description, [F].
    """

    labels: tuple[str, ...]
    columns: np.ndarray
    low: np.ndarray
    high: np.ndarray
    in_parts: np.ndarray
    _nominal: np.ndarray
    _unit: np.ndarray

    @classmethod
    def of(cls, names: Sequence[str], spec: RobotSpec, layout: ParameterLayout) -> "Unknowns":
        """Choose parameters by name.

        Raises:
            UserError: If there is no such parameter, or what is found as a factor is zero in the description.
        """
        nominal = layout.nominal.double().numpy()
        units = {
            "payload": np.array([_PAYLOAD]),
            "joint_friction": _FRICTION * spec.effort_limit,
            "armature": _ARMATURE * spec.effort_limit,
            "velocity_gain": np.full(len(spec.joints), _GAIN),
            "encoder_offset": np.full(len(spec.joints), _OFFSET),
        }
        labels: list[str] = []
        each: list[str] = []
        columns: list[int] = []
        unit: list[float] = []
        for name in dict.fromkeys(names):
            if name not in FITTED:
                raise UserError(f"fit: '{name}' is none of {', '.join(FITTED)}{nearest(name, FITTED)}")
            places = range(layout.columns[name].start, layout.columns[name].stop)
            if name in _IN_PARTS and not nominal[layout.columns[name]].all():
                raise UserError(f"fit: {name} is zero in the description of '{spec.name}': give a nominal value there")
            labels += [layout.labels[place] for place in places]
            each += [name] * len(places)
            columns += places
            unit += [1.0] * len(places) if name in _IN_PARTS else units[name].tolist()
        at = nominal[columns]
        in_parts = np.isin(each, _IN_PARTS)
        low, high = np.full(len(each), -_FARTHEST), np.full(len(each), _FARTHEST)
        scale = np.array(unit)
        for name, least, most in (
            ("payload", 0.0, np.inf),
            ("joint_friction", 0.0, np.inf),
            ("armature", 0.0, np.inf),
            ("velocity_gain", 0.05, 1.0),
        ):
            rows = np.array(each) == name
            low[rows] = np.maximum(low[rows], (least - at[rows]) / scale[rows])
            high[rows] = np.minimum(high[rows], (most - at[rows]) / scale[rows])
        return cls(tuple(labels), np.array(columns), low, high, in_parts, nominal, scale)

    def __len__(self) -> int:
        return len(self.labels)

    def parameters(self, coordinates: np.ndarray) -> np.ndarray:
        """Map coordinates [R, F] to ``physics_parameters`` [R, P]."""
        rows = np.repeat(self._nominal[None], len(coordinates), axis=0)
        at, steps = self._nominal[self.columns], coordinates * self._unit
        rows[:, self.columns] = np.where(self.in_parts, at * np.exp(np.where(self.in_parts, steps, 0.0)), at + steps)
        return rows

    def values(self, coordinates: np.ndarray) -> np.ndarray:
        """Map coordinates [R, F] to what they stand for, in SI units, [R, F]."""
        return self.parameters(coordinates)[:, self.columns]

    def coordinates(self, parameters: np.ndarray) -> np.ndarray:
        """Map ``physics_parameters`` [P] to coordinates [F]."""
        at, value = self._nominal[self.columns], parameters[self.columns]
        with np.errstate(divide="ignore", invalid="ignore"):
            found: np.ndarray = np.where(self.in_parts, np.log(value / at), value - at) / self._unit
        return found
