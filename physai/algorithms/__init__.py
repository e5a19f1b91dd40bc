"""Learning from collected frames."""

from physai.algorithms.on_policy import NonFiniteError, OnPolicy
from physai.algorithms.ppo_loss import FusedClipPPOLoss

__all__ = ["FusedClipPPOLoss", "NonFiniteError", "OnPolicy"]
