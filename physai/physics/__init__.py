"""A batch of simulated robots behind one small interface."""

from physai.physics.actuation import ActuatorDelay
from physai.physics.interface import DynamicsParameters, Physics, RobotState, nominal_dynamics
from physai.physics.parameters import ParameterLayout
from physai.physics.randomization import RandomizationConfig
from physai.physics.sensing import ImuErrors, SensorErrors

__all__ = [
    "ActuatorDelay",
    "DynamicsParameters",
    "ImuErrors",
    "ParameterLayout",
    "Physics",
    "RandomizationConfig",
    "RobotState",
    "SensorErrors",
    "nominal_dynamics",
]
