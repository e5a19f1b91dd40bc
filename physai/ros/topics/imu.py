"""What the IMU of a robot on legs tells (sensor_msgs/Imu, REP-145)."""

import math
import time

from rclpy.node import Node
from sensor_msgs.msg import Imu as ImuMessage

from physai.deploy import Imu
from physai.ros.topics import qos
from physai.ros.topics.joint_states import Publishers

TOPIC = "imu"  # in the robot's namespace
_PART = frozenset({TOPIC})


class ImuTopic:
    """Keeps the newest reading until it is taken.

    Args:
        node: Whose remaps hold.
    """

    def __init__(self, node: Node) -> None:
        self._newest: Imu | None = None
        self._publishers = Publishers()
        self._node, self._topic = node, node.resolve_topic_name(TOPIC)
        node.create_subscription(
            ImuMessage,
            TOPIC,
            self._take,  # type: ignore[arg-type]  # rclpy also takes callbacks with two arguments
            qos.SENSOR,
        )

    def _take(self, message: ImuMessage, info: dict[str, int]) -> None:
        turn, rate, stamp = message.orientation, message.angular_velocity, message.header.stamp
        self._publishers.source(_PART, info["publication_sequence_number"], time.monotonic())
        # A covariance that begins with -1 says that there is none (sensor_msgs/Imu).
        no_turn, no_rate = message.orientation_covariance[0] == -1, message.angular_velocity_covariance[0] == -1
        self._newest = Imu(
            (math.nan,) * 4 if no_turn else (turn.x, turn.y, turn.z, turn.w),
            (math.nan,) * 3 if no_rate else (rate.x, rate.y, rate.z),
            stamp.sec + stamp.nanosec * 1e-9,
            message.header.frame_id,
            qos.received_at(info),
        )

    def rivals(self, now: float) -> str | None:
        """Who tells of the same base, if two do; None if nobody does."""
        if self._publishers.contested(now) is None:
            return None
        names = sorted(info.node_name for info in self._node.get_publishers_info_by_topic(self._topic))
        return f"two publishers of {self._topic}: {', '.join(names)}"

    def take(self) -> Imu | None:
        """Return what has come since the last time."""
        imu, self._newest = self._newest, None
        return imu
