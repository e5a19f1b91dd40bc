"""Goals in messages: places and joint configurations go in and come out as the policy's signal says."""

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped, PoseStamped, Twist
from sensor_msgs.msg import JointState

from physai.errors import UserError
from physai.ros.topics import goals
from physai.signals import Quantity, Signal

PLACE = Signal("goal", Quantity.POSITION, (3,), labels=("x", "y", "z"), frame="base")
PLANE = Signal("goal", Quantity.POSITION, (2,), labels=("x", "y"), frame="base")
POSE = Signal("goal", Quantity.POSE, (7,), labels=("x", "y", "z", "qx", "qy", "qz", "qw"), frame="base")
JOINTS = Signal("goal", Quantity.JOINT_POSITION, (2,), labels=("a", "b"))

TWIST = Signal("goal", Quantity.TWIST, (3,), labels=("vx", "vy", "yaw_rate"), frame="trunk")


@pytest.mark.parametrize(
    "signal", [PLACE, PLANE, POSE, JOINTS], ids=["in space", "in the plane", "a pose", "of joints"]
)
def test_a_goal_comes_out_of_its_message_as_it_went_in(signal):
    value = [0.1, -0.2, 0.3, 0.5, -0.5, 0.5, 0.5][: signal.size]
    message = goals.to_message(value, signal, Time(sec=7))
    assert message.header.stamp.sec == 7
    goal = goals.from_message(message, signal)
    assert list(goal.value) == value
    assert (goal.frame, goal.names) == (signal.frame, () if signal is not JOINTS else ("a", "b"))


def test_a_velocity_comes_out_of_its_message_in_the_frame_of_the_base_and_has_a_topic_of_its_own():
    message = goals.to_message([0.5, 0.1, -0.2], TWIST, Time(sec=7))
    assert (message.linear.x, message.linear.y, message.angular.z) == (0.5, 0.1, -0.2)
    assert goals.from_message(message, TWIST) == goals.Goal([0.5, 0.1, -0.2], "trunk")
    assert (goals.topic(TWIST), goals.topic(POSE)) == ("~/cmd_vel", "~/goal")


def test_the_type_of_a_message_follows_from_the_quantity():
    assert goals.goal_type(PLACE) is goals.goal_type(PLANE) is PointStamped
    assert goals.goal_type(POSE) is PoseStamped
    assert goals.goal_type(JOINTS) is JointState
    assert goals.goal_type(TWIST) is Twist
    with pytest.raises(UserError, match="the policy's goal is a joint_velocity: no ROS message"):
        goals.goal_type(Signal("goal", Quantity.JOINT_VELOCITY, (2,)))


def test_a_goal_is_described_with_unit_and_frame():
    assert goals.describe(goals.Goal([0.1, 0.4], "base"), PLANE) == "(0.1, 0.4) m, in 'base'"
    assert goals.describe(goals.Goal([1.0, 2.0]), JOINTS) == "(1, 2) rad"
