"""Velocity commands to a controller: is it there, is it ours alone, and do they end with zero."""

import time
from array import array
from collections.abc import Sequence

from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from physai.ros import qos

TOPIC = "/joint_velocity_controller/commands"
_LAST_ZEROS, _PERIOD = 5, 0.02  # s
_ACKNOWLEDGED = 0.5  # s


class VelocityCommands:
    """Publishes std_msgs/Float64MultiArray, rad/s, to a ros2_control velocity controller.

    Args:
        node: Whose remaps hold.
        joints: How many velocities a command has.
    """

    def __init__(self, node: Node, joints: int) -> None:
        self._node = node
        self._publisher = node.create_publisher(Float64MultiArray, TOPIC, qos.COMMAND)
        self.topic: str = self._publisher.topic_name
        self._message = Float64MultiArray()
        self.resize(joints)

    def resize(self, joints: int) -> None:
        """Take another number of velocities in a command."""
        self._message.data = array("d", [0.0] * joints)

    @property
    def rival(self) -> str | None:
        """Another publisher of the same topic, or None."""
        if self._node.count_publishers(self.topic) <= 1:
            return None
        names = [info.node_name for info in self._node.get_publishers_info_by_topic(self.topic)]
        others = [name for name in names if name != self._node.get_name()] or ["a node of the same name"]
        return ", ".join(sorted(others))

    @property
    def heard(self) -> bool:
        """Whether a controller listens."""
        return self._publisher.get_subscription_count() > 0

    def send(self, velocity: Sequence[float]) -> None:
        """Publish a command."""
        for index, value in enumerate(velocity):
            self._message.data[index] = value
        self._publisher.publish(self._message)

    def stop(self) -> None:
        """Publish zeros."""
        self.send([0.0] * len(self._message.data))

    def finish(self) -> None:
        """Publish zeros until they have surely arrived: a reliable writer of depth 1 forgets what it has replaced."""
        for _ in range(_LAST_ZEROS):
            self.stop()
            time.sleep(_PERIOD)
        self._publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGED))
