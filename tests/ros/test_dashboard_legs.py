"""Robots on legs on the dashboard: all four legs are drawn, and turned as the IMU says."""

import time

import pytest
from sensor_msgs.msg import Imu, JointState

from physai.ros.live.arm_view import ArmView
from physai.ros.live.robots import Robots
from physai.ros.live.status import Level
from physai.web import serve
from tests.waiting import wait_for


@pytest.mark.slow
def test_legs_are_drawn_as_their_joints_and_their_imu_tell(start, peer, walking_run, walking_policy):
    """Some seconds, for a node: nothing else sees that its description, its joints and its IMU come together."""
    joints = list(walking_policy.metadata.joints)
    start("inference_node", policy_path=walking_run / "policy.pt")
    robots = Robots(peer.node, True)
    peer.node.create_timer(0.1, robots.look)
    (status,) = wait_for(lambda: robots.all, 60.0, "a robot that is found")
    wait_for(lambda: status.description and status.goal_description, 30.0, "its descriptions")
    turn = Imu()
    turn.orientation.x, turn.orientation.w = 0.6, 0.8

    def told() -> bool:
        peer.publish("/joint_states", JointState(name=joints, position=[0.1] * len(joints)))
        peer.publish("/imu", turn)
        time.sleep(0.05)
        return bool(status.joint_position) and status.turn is not None

    wait_for(told, 30.0, "joints and a turn")
    assert status.turn == pytest.approx([0.6, 0.0, 0.0, 0.8])
    with serve("127.0.0.1", 0, "legs", 0.5) as server:
        view = ArmView(server, status, None)
        view.show(status, Level.FINE, False, time.monotonic())
        assert len(view.position) == len(joints)
        assert view.position == pytest.approx(0.1)
        assert view._scene._base.wxyz == pytest.approx([0.8, 0.6, 0.0, 0.0])
        assert "twist" in view.problem
