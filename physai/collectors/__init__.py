"""Collecting frames: from robots in this process, or in several."""

from physai.collectors.make import CollectorConfig, make_collector
from physai.collectors.multi_sync import RobotMultiCollector
from physai.collectors.single import RobotCollector

__all__ = ["CollectorConfig", "RobotCollector", "RobotMultiCollector", "make_collector"]
