"""What a virtual robot tells of a base that floats: its IMU, and where it truly is."""

import numpy as np
from geometry_msgs.msg import Point, Quaternion, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Imu

from physai.ros.topics import imu
from physai.ros.virtual.arm import Base

ODOMETRY, _WORLD = "odom", "odom"  # a topic in the robot's namespace, and the frame of its poses (REP-105)


class BaseTopics:
    """Publishes imu and odom.

    Args:
        node: Whose remaps hold.
        frame: Name of the base's link.
    """

    def __init__(self, node: Node, frame: str) -> None:
        self._frame = frame
        self._imu = node.create_publisher(Imu, imu.TOPIC, 10)
        self._odometry = node.create_publisher(Odometry, ODOMETRY, 10)

    def publish(self, base: Base, stamp: Time) -> None:
        """Tell of a moment."""
        reading = Imu(orientation=_quaternion(base.told_orientation), angular_velocity=_vector(base.told_rate))
        reading.header.stamp, reading.header.frame_id = stamp.to_msg(), self._frame
        self._imu.publish(reading)
        odometry = Odometry(child_frame_id=self._frame)
        odometry.header.stamp, odometry.header.frame_id = stamp.to_msg(), _WORLD
        x, y, z = base.pose[:3].tolist()
        odometry.pose.pose.position = Point(x=x, y=y, z=z)
        odometry.pose.pose.orientation = _quaternion(base.pose[3:])
        odometry.twist.twist.linear, odometry.twist.twist.angular = _vector(base.velocity), _vector(base.rate)
        self._odometry.publish(odometry)


def _vector(values: np.ndarray) -> Vector3:
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def _quaternion(values: np.ndarray) -> Quaternion:
    x, y, z, w = values.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)
