"""Goals as ROS messages: which type a goal signal travels in, and how it gets in and out of it."""

from collections.abc import Sequence
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped, PoseStamped, Twist
from rclpy.node import Node
from sensor_msgs.msg import JointState

from physai.deploy import Goal
from physai.errors import UserError
from physai.signals import Quantity, Signal

DESCRIPTION = "~/goal_description"
"""What goals are, and where they lie: the JSON of :func:`physai.deploy.metadata.describe_goal`, latched."""

_TYPES = {
    Quantity.POSITION: PointStamped,
    Quantity.POSE: PoseStamped,
    Quantity.JOINT_POSITION: JointState,
    Quantity.TWIST: Twist,
}
_POSITION, _ORIENTATION = ("x", "y", "z"), ("x", "y", "z", "w")


def goal_type(signal: Signal) -> Any:
    """Return the message type of a goal signal: PointStamped, PoseStamped, JointState or Twist.

    Raises:
        UserError: If there is none for its quantity.
    """
    if signal.quantity not in _TYPES:
        raise UserError(f"the policy's goal is a {signal.quantity.value}: no ROS message of this node carries it")
    return _TYPES[signal.quantity]


def topic(signal: Signal) -> str:
    """Name the topic of a goal signal, within those of its node."""
    return "~/cmd_vel" if signal.quantity is Quantity.TWIST else "~/goal"


def from_message(message: Any, signal: Signal) -> Goal:
    """Take a goal out of a message of ``goal_type``."""
    if signal.quantity is Quantity.JOINT_POSITION:
        return Goal(message.position.tolist(), names=tuple(message.name))
    if signal.quantity is Quantity.TWIST:  # which has no frame: it is that of the base
        return Goal([message.linear.x, message.linear.y, message.angular.z], signal.frame)
    if signal.quantity is Quantity.POSE:
        position, orientation = message.pose.position, message.pose.orientation
        value = [getattr(position, axis) for axis in _POSITION] + [getattr(orientation, axis) for axis in _ORIENTATION]
        return Goal(value, message.header.frame_id)
    return Goal([getattr(message.point, axis) for axis in signal.labels], message.header.frame_id)


def to_message(value: Sequence[float], signal: Signal, stamp: Time) -> Any:
    """Put a goal, numbers in the signal's order, into a message of ``goal_type``."""
    message = goal_type(signal)()
    if signal.quantity is Quantity.TWIST:
        message.linear.x, message.linear.y, message.angular.z = map(float, value)
        return message
    message.header.stamp = stamp
    if signal.quantity is Quantity.JOINT_POSITION:
        message.name, message.position = list(signal.labels), [float(number) for number in value]
        return message
    message.header.frame_id = signal.frame
    if signal.quantity is Quantity.POSE:
        for axis, number in zip(_POSITION, value[:3], strict=True):
            setattr(message.pose.position, axis, float(number))
        for axis, number in zip(_ORIENTATION, value[3:], strict=True):
            setattr(message.pose.orientation, axis, float(number))
    else:
        for axis, number in zip(signal.labels, value, strict=True):
            setattr(message.point, axis, float(number))
    return message


def other_types(node: Node, topic: str, signal: Signal) -> list[str]:
    """Types of messages that others send to a goal topic, and that do not arrive: they are not the goal signal's."""
    wanted = goal_type(signal)
    own = f"{wanted.__module__.partition('.')[0]}/msg/{wanted.__name__}"
    return sorted({info.topic_type for info in node.get_publishers_info_by_topic(topic)} - {own})


def describe(goal: Goal, signal: Signal) -> str:
    """Say what a goal is, for the log."""
    numbers = ", ".join(f"{number:g}" for number in goal.value)
    return f"({numbers}) {signal.unit}".rstrip() + (f", in '{goal.frame}'" if goal.frame else "")
