"""TorchRL transforms between the robot's sensors and the policy's input."""

from physai.transforms.memory import Memory
from physai.transforms.normalization import Normalizer, ObservationNormalization, RunningStatistics
from physai.transforms.observation import Observation
from physai.transforms.randomization import DomainRandomization, GrowingRandomization
from physai.transforms.ranges import Ranges
from physai.transforms.sensing import ImuModel, SensorModel

__all__ = [
    "DomainRandomization",
    "GrowingRandomization",
    "ImuModel",
    "Memory",
    "Normalizer",
    "Observation",
    "ObservationNormalization",
    "Ranges",
    "RunningStatistics",
    "SensorModel",
]
