"""TorchRL transforms between the robot's sensors and the policy's input, and between its output and the motors."""

from physai.transforms.actuation import ActuatorDelay
from physai.transforms.memory import Memory
from physai.transforms.normalization import ObservationNormalization
from physai.transforms.observation import Observation
from physai.transforms.randomization import DomainRandomization
from physai.transforms.sensing import SensorModel

__all__ = [
    "ActuatorDelay",
    "DomainRandomization",
    "Memory",
    "Observation",
    "ObservationNormalization",
    "SensorModel",
]
