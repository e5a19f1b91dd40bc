"""A batch of simulated robots behind one small interface."""

from physai.physics.interface import DynamicsParameters, Physics, nominal_dynamics
from physai.physics.parameters import ParameterLayout

__all__ = ["DynamicsParameters", "ParameterLayout", "Physics", "nominal_dynamics"]
