"""The inference node and the virtual robot, each in its own process."""

import pytest

from tests.ros.peer import node_command


def reach_goal_after_goal(start, peer, policy_path):
    start.run(node_command("virtual_robot"))
    parameters = {"policy_path": policy_path, "autostart": True, "max_velocity": 1.0, "limit_margin": 0.2}
    start.run(node_command("inference_node", **parameters))
    for x, y in [(0.1, 0.4), (-0.3, -0.2), (0.4, 0.0)]:
        peer.wait_state("waiting", "reached")
        peer.send_goal(x, y)
        since, _ = peer.wait_state("active")
        peer.wait_state("reached", after=since)
    assert max(abs(v) for _, command in peer.commands for v in command) <= 1.0 + 1e-9


@pytest.mark.slow
def test_the_arm_reaches_goal_after_goal(start, peer, policy_path):
    reach_goal_after_goal(start, peer, policy_path)


@pytest.mark.slow
def test_with_a_policy_that_remembers_it_does_too(start, peer, recurrent_run):
    reach_goal_after_goal(start, peer, recurrent_run / "policy.pt")
