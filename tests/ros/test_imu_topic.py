"""What an IMU says on its topic: taken as it is, without what it has not; and two of them are named."""

import math
import time

import pytest
from sensor_msgs.msg import Imu

from physai.errors import UserError
from physai.ros.driving.policies import robot_engine, robot_overrides
from physai.ros.fleet import FleetConfig
from physai.ros.inference_node import InferenceConfig, _first_goal
from physai.ros.topics.imu import ImuTopic
from tests.waiting import wait_for


def reading(number, frame="trunk"):
    message = Imu()
    message.header.frame_id, message.header.stamp.sec = frame, number
    message.angular_velocity.x, message.angular_velocity.y = 0.1, float(number)
    message.orientation.x, message.orientation.w = 0.6, 0.8
    return message


def told(topic, peer, message):
    peer.publish("/imu", message)
    return wait_for(topic.take, what="a reading")


def test_a_reading_comes_as_it_is_and_is_taken_once(peer):
    topic = ImuTopic(peer.node)
    found = told(topic, peer, reading(7))
    assert (found.orientation, found.angular_velocity) == ((0.6, 0.0, 0.0, 0.8), (0.1, 7.0, 0.0))
    assert (found.stamp, found.frame) == (7.0, "trunk")
    assert 0.0 <= time.monotonic() - found.received < 10.0
    assert topic.take() is None


def test_what_an_imu_says_that_it_has_not_is_no_number(peer):
    topic, message = ImuTopic(peer.node), reading(1)
    message.orientation_covariance[0] = -1.0
    found = told(topic, peer, message)
    assert all(map(math.isnan, found.orientation))
    assert found.angular_velocity == (0.1, 1.0, 0.0)


def test_two_that_take_turns_are_named(peer):
    topic = ImuTopic(peer.node)
    other = peer.node.create_publisher(Imu, "/imu", 10)
    for number in range(1, 5):
        told(topic, peer, reading(2 * number))
    assert topic.rivals(time.monotonic()) is None
    for number in range(5, 8):
        other.publish(reading(2 * number + 1))
        wait_for(topic.take, what="a reading of the other one")
        told(topic, peer, reading(2 * number))
    assert topic.rivals(time.monotonic()) == "two publishers of /imu: peer, peer"


@pytest.mark.slow
def test_legs_are_no_arm_of_a_fleet_and_take_no_goal_to_start_with(walking_run, walking_policy):
    path = walking_run / "policy.pt"
    fleet = {"arms": 2, "max_velocity": 1.0, "hold": 1.0, "seconds": 1.0, "randomization": {}, "seed": 0}
    fleet |= {"render": None, "web": {"host": "127.0.0.1", "port": 0}}
    with pytest.raises(UserError, match="a fleet is of arms, and 'a1' is on legs"):
        FleetConfig(policies=[str(path)], **fleet).fleet()
    with pytest.raises(UserError, match=r"goal: a velocity is out of date .* send them on ~/cmd_vel"):
        _first_goal(InferenceConfig(goal=(0.5, 0.0, 0.0)), walking_policy)


@pytest.mark.slow
def test_the_demo_simulates_the_springs_and_the_engine_that_legs_were_trained_with(walking_policy):
    overrides = robot_overrides(walking_policy.metadata)
    assert "env.robot.servo.stiffness=[80.0]" in overrides
    assert robot_engine(walking_policy.metadata) == "mujoco"
