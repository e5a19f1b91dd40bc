"""The inference node and the virtual robot, each in its own process."""

import time

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from physai.deploy import load_policy
from tests.ros.forge import forged
from tests.ros.loop import FAR, Arm
from tests.ros.peer import Peer, free_domain, node_command

PARAMETERS = {"autostart": True, "max_velocity": 1.0, "limit_margin": 0.2}


def reach_goals(peer, *goals):
    for x, y in goals:
        peer.wait_state("waiting", "reached")
        peer.send_goal(x, y)
        since, _ = peer.wait_state("active")
        peer.wait_state("reached", after=since)
    assert max(abs(v) for _, command in peer.commands for v in command) <= 1.0 + 1e-9


@pytest.mark.realtime
@pytest.mark.slow
def test_the_arm_reaches_goal_after_goal(start, peer, policy_path):
    """The nodes are started as a user starts them."""
    start.run(node_command("virtual_robot"))
    start.run(node_command("inference_node", policy_path=policy_path, **PARAMETERS))
    reach_goals(peer, (0.1, 0.4), (-0.3, -0.2), (0.4, 0.0))


@pytest.mark.slow
def test_each_joint_is_commanded_at_its_place_and_one_that_is_not_the_policy_s_stands_still(policy_path):
    with free_domain() as domain:
        peer = Peer(domain)
        states = peer.publisher(JointState, "/joint_states")

        def tell() -> None:
            message = JointState(name=Arm.NAMES, position=Arm.HOME, velocity=[0.0, 0.0])
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
            states.publish(message)

        peer.node.create_timer(0.01, tell)
        # This arm does not move, and the peer may hear of the commands only after a while.
        parameters = {"joints": "[gripper, joint2, joint1]", "goal": list(FAR), "following_error": 100.0}
        node = forged("inference_node", domain, policy_path=policy_path, autostart=True, **parameters)
        try:
            peer.moved(commands=1)
            gripper, *others = next(command for _, command in peer.commands if any(command))
            wanted = load_policy(policy_path)(Arm.HOME, [0.0, 0.0], FAR)[::-1]
            assert gripper == 0.0
            np.testing.assert_allclose(others / np.abs(others).max(), wanted / np.abs(wanted).max(), atol=1e-5)
        finally:
            node.end()
            peer.close()


@pytest.mark.realtime
@pytest.mark.slow
def test_with_a_policy_that_remembers_it_does_too(start, peer, recurrent_run):
    start("virtual_robot")
    start("inference_node", policy_path=recurrent_run / "policy.pt", **PARAMETERS)
    reach_goals(peer, (0.1, 0.4), (-0.3, -0.2))
