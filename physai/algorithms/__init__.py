"""Learning from collected frames."""

from physai.algorithms.on_policy import NonFiniteError, OnPolicy

__all__ = ["NonFiniteError", "OnPolicy"]
