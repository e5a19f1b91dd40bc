"""What the IMU of a robot on legs tells (sensor_msgs/Imu, REP-145)."""

from rclpy.node import Node
from sensor_msgs.msg import Imu as ImuMessage

from physai.deploy import Imu
from physai.ros.topics import qos

TOPIC = "imu"  # in the robot's namespace


class ImuTopic:
    """Keeps the newest reading until it is taken.

    Args:
        node: Whose remaps hold.
    """

    def __init__(self, node: Node) -> None:
        self._newest: Imu | None = None
        node.create_subscription(
            ImuMessage,
            TOPIC,
            self._take,  # type: ignore[arg-type]  # rclpy also takes callbacks with two arguments
            qos.SENSOR,
        )

    def _take(self, message: ImuMessage, info: dict[str, int]) -> None:
        turn, rate, stamp = message.orientation, message.angular_velocity, message.header.stamp
        self._newest = Imu(
            (turn.x, turn.y, turn.z, turn.w),
            (rate.x, rate.y, rate.z),
            stamp.sec + stamp.nanosec * 1e-9,
            message.header.frame_id,
            qos.received_at(info),
        )

    def take(self) -> Imu | None:
        """Return what has come since the last time."""
        imu, self._newest = self._newest, None
        return imu
