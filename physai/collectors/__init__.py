"""Collection of frames: a config becomes a TorchRL collector."""

from physai.collectors.single import CollectorConfig, RobotCollector, make_collector

__all__ = ["CollectorConfig", "RobotCollector", "make_collector"]
