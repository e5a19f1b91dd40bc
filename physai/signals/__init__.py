"""What crosses a boundary, declared once: specs, spaces, policy files, checks and messages follow from it."""

from physai.signals.region import Ball, Box, Reachable, Region, Ring
from physai.signals.signal import Quantity, Signal, Tolerance

__all__ = ["Ball", "Box", "Quantity", "Reachable", "Region", "Ring", "Signal", "Tolerance"]
