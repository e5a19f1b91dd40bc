"""A robot on legs over ROS 2: it walks past corners, stands without commands, and sinks down in an emergency."""

import signal
import time

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from physai.ros.topics.commands import controller_topic
from physai.signals import Quantity
from tests.waiting import wait_for

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
COMMANDS = f"/{controller_topic(Quantity.JOINT_POSITION)}"


@pytest.fixture
def walker(start, peer, walking_run):
    """A virtual A1 under its node and a watchdog, and what is heard of it; it walks ahead when it is told to."""
    peer.told, peer.odometry, peer.imu = [], [], []
    peer.listen(Float64MultiArray, COMMANDS, peer.told, 1000, lambda message: np.array(message.data))
    peer.listen(Odometry, "/odom", peer.odometry, 10)
    peer.listen(Imu, "/imu", peer.imu, 10)
    robot = start("virtual_robot", env="a1_walk", physics="mujoco", randomization="default")
    robot.says("takes joint_position of ['FR_hip_joint'", 60.0)
    peer.watchdog = start("command_watchdog", command="joint_position", joints=12)
    start("inference_node", policy_path=walking_run / "policy.pt", autostart=True, watchdog="command_watchdog")
    peer.wait_state("waiting", timeout=60.0)

    def walk(until, seconds):
        end, twist = time.monotonic() + seconds, Twist()
        twist.linear.x = 0.5
        while not until():
            assert time.monotonic() < end, peer.states[-5:]
            peer.publish("/inference_node/cmd_vel", twist)
            time.sleep(0.05)

    peer.walk = walk
    walk(lambda: peer.states[-1][1] == "active", 60.0)
    return peer


def place(peer):
    at = peer.odometry[-1][1].pose.pose.position
    return np.array([at.x, at.y, at.z])


def speed(peer):
    velocity = peer.odometry[-1][1].twist.twist.linear
    return float(np.hypot(velocity.x, velocity.y))


def test_it_walks_as_it_is_told_stands_without_a_command_and_sinks_in_an_emergency_stop(walker):
    start = place(walker)
    walker.walk(lambda: np.linalg.norm((place(walker) - start)[:2]) > 1.0, 90.0)
    assert place(walker)[2] > 0.2

    wait_for(lambda: speed(walker) < 0.05, 5.0, "a robot that stands")
    reasons = lambda: walker.diagnostics[-1][1].status[0].message  # noqa: E731
    wait_for(lambda: "it stands" in reasons(), 5.0, reasons)

    walker.emergency_stop()
    walker.wait_state("estop")
    time.sleep(1.5)
    told, joints = walker.told[-1][1], np.array(walker.joint_states[-1][1].position)
    np.testing.assert_allclose(told, joints, atol=0.05)  # each is told to be where it is
    assert place(walker)[2] < 0.2


@pytest.mark.fault("the watchdog is silent")
def test_it_keeps_its_stance_while_the_watchdog_is_silent_and_walks_when_it_is_back(walker):
    start = place(walker)
    walker.walk(lambda: np.linalg.norm((place(walker) - start)[:2]) > 0.3, 60.0)
    time.sleep(2.0)  # without a command for 0.5 s it walks to a stand, and then has stood for a second
    assert ": it stands" in walker.diagnostics[-1][1].status[0].message
    walker.watchdog.signal(signal.SIGSTOP)
    walker.wait_state("waiting")
    since = time.monotonic()
    time.sleep(2.0)
    told = np.array([positions for at, positions in walker.told if at > since])
    assert len(told) > 50
    np.testing.assert_array_equal(told, told[:1].repeat(len(told), axis=0))
    assert place(walker)[2] > 0.2

    walker.watchdog.signal(signal.SIGCONT)
    start = place(walker)
    walker.walk(lambda: np.linalg.norm((place(walker) - start)[:2]) > 0.3, 60.0)
    assert place(walker)[2] > 0.2


def test_the_virtual_robot_tells_what_its_imu_feels_and_where_it_is(walker):
    reading, odometry = walker.imu[-1][1], walker.odometry[-1][1]
    turn = reading.orientation
    assert reading.header.frame_id == "trunk"
    assert np.linalg.norm([turn.x, turn.y, turn.z, turn.w]) == pytest.approx(1.0)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "trunk")
    stamps = [message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 for _, message in walker.imu[-50:]]
    assert np.diff(stamps).min() > 0


def test_the_demo_walks_past_corners_and_draws_the_path(start, walking_run, tmp_path):
    picture = tmp_path / "path.png"
    overrides = (f"policy_path={walking_run / 'policy.pt'}", f"output={picture}", "randomization=default")
    process = start.command("ros.demo", *overrides, "goals=2", "hold=1")
    assert process.wait(240) == 0, process.output
    assert "2 of 2 corners passed within 0.5 m" in process.output
    assert picture.stat().st_size > 10_000
