"""What crosses a boundary, declared once: specs, spaces, policy files, checks and messages follow from it."""

from physai.signals.region import Box, Region, Ring
from physai.signals.signal import Quantity, Signal, Tolerance

__all__ = ["Box", "Quantity", "Region", "Ring", "Signal", "Tolerance"]
