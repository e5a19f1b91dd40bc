"""Collecting frames: from robots in this process, in several, or on a cluster."""

from physai.collectors.forked import RobotMultiCollector
from physai.collectors.interface import FrameSource
from physai.collectors.make import CollectorConfig, make_collector
from physai.collectors.multi_async import RobotMultiAsyncCollector
from physai.collectors.multi_sync import RobotMultiSyncCollector
from physai.collectors.single import RobotCollector

__all__ = [
    "CollectorConfig",
    "FrameSource",
    "RobotCollector",
    "RobotMultiAsyncCollector",
    "RobotMultiCollector",
    "RobotMultiSyncCollector",
    "make_collector",
]
