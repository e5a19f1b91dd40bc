"""A batch of simulated robots behind one small interface."""

from physai.physics.interface import DynamicsParameters, Physics, nominal_dynamics
from physai.physics.parameters import ParameterLayout
from physai.physics.randomization import RandomizationConfig

__all__ = ["DynamicsParameters", "ParameterLayout", "Physics", "RandomizationConfig", "nominal_dynamics"]
