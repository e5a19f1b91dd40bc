"""Qualities of service, and why (REP-2003 and the QoS pages of ROS 2 Jazzy name the policies)."""

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

SENSOR = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches every publisher; only the latest message counts, and none waits for a lost one."""

COMMAND = QoSProfile(depth=1)
"""Reliable; a newer command replaces one that has not arrived."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Reliable; who comes later gets the last message."""

EMERGENCY = (SENSOR, COMMAND, LATCHED)
"""Three subscriptions, so that a message is heard from every kind of publisher, also one that was sent before."""
