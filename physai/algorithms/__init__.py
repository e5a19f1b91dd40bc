"""Learning from collected frames."""

from physai.algorithms.distill import Distill, Teacher
from physai.algorithms.interface import Algorithm, Networks, NonFiniteError
from physai.algorithms.off_policy import OffPolicy
from physai.algorithms.on_policy import OnPolicy
from physai.algorithms.ppo_loss import FusedClipPPOLoss
from physai.algorithms.proportional import ProportionalSampler

__all__ = [
    "Algorithm",
    "Distill",
    "FusedClipPPOLoss",
    "Networks",
    "NonFiniteError",
    "OffPolicy",
    "OnPolicy",
    "ProportionalSampler",
    "Teacher",
]
