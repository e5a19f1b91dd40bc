"""A robot that is no ROS node, and uses another implementation of DDS."""

import sys
from pathlib import Path

import pytest

from physai.deploy import load_policy
from tests.ros.forge import forged
from tests.ros.peer import Process


@pytest.mark.slow
def test_closes_the_loop_until_the_goal_is_reached(policy_path, domain):
    goal = [0.1, 0.4]
    node = forged("inference_node", domain, policy_path=policy_path, autostart=True, goal=goal)
    robot = Process([sys.executable, str(Path(__file__).with_name("dds_peer.py")), str(domain)], domain)
    try:
        assert robot.wait(60) == 0, robot.output
        assert "rclpy" not in robot.output
        said = [line.split()[-1] for line in robot.lines if line.startswith("the node says")]
        assert said[-2:] == ["active", "reached"]
        position = [float(word) for word in robot.lines[-1].split("[")[1].rstrip("]").split(",")]
        policy = load_policy(policy_path)
        assert policy.error(position, goal) < policy.metadata.tolerances[0].value
    finally:
        robot.end()
        node.end()
