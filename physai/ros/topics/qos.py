"""How messages travel: qualities of service, and why (REP-2003 names the policies); and when one has come."""

import time

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

SENSOR = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches every publisher; only the latest message counts, and none waits for a lost one."""

PARTS = QoSProfile(depth=64, reliability=ReliabilityPolicy.BEST_EFFORT)
"""As SENSOR, but deep: a gripper's messages at 1,000 Hz must not push out those of the arm."""

COMMAND = QoSProfile(depth=1)
"""Reliable; a newer command replaces one that has not arrived."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Reliable; who comes later gets the last message."""

EMERGENCY = (QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT), QoSProfile(depth=100))
EMERGENCY_LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Three subscriptions, so that a message is heard from every kind of publisher, also one that was sent before; and
deep ones, so that a true is not replaced by the false that follows it."""

SILENT_PUBLISHER = PublisherEventCallbacks(use_default_callbacks=False)
SILENT_SUBSCRIPTION = SubscriptionEventCallbacks(use_default_callbacks=False)
"""Where it is no fault, or is told otherwise, that the other side wants another quality of service."""


def received_at(info: dict[str, int]) -> float:
    """When a message came to this computer, s on ``time.monotonic``: it may have waited for the thread that asks.

    Args:
        info: What rclpy gives to callbacks that take two arguments.
    """
    arrived = info["received_timestamp"]  # ns since 1970; 0 from middlewares that do not say
    waited = max(0.0, (time.time_ns() - arrived) * 1e-9) if arrived else 0.0
    return time.monotonic() - waited
