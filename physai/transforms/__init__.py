"""TorchRL transforms between the robot's sensors and the policy's input."""

from physai.transforms.memory import Memory
from physai.transforms.normalization import Normalizer, ObservationNormalization, RunningStatistics
from physai.transforms.observation import Observation
from physai.transforms.randomization import DomainRandomization
from physai.transforms.sensing import SensorModel

__all__ = [
    "DomainRandomization",
    "Memory",
    "Normalizer",
    "Observation",
    "ObservationNormalization",
    "RunningStatistics",
    "SensorModel",
]
