"""Collecting frames: from robots in this process, in several, or on a cluster."""

from physai.collectors.interface import FrameSource
from physai.collectors.make import CollectorConfig, make_collector

__all__ = ["CollectorConfig", "FrameSource", "make_collector"]
