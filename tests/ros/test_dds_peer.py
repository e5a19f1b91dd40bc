"""A robot that is no ROS node, and uses another implementation of DDS."""

import sys
from pathlib import Path

import pytest

from physai.deploy import load_policy
from tests.ros.forge import forged
from tests.ros.peer import Process
from tests.waiting import wait_for


def reach(run: Path, goal: list[float], domain: int) -> None:
    policy = load_policy(run / "policy.pt")
    home = policy.metadata.raw["config"]["env"]["robot"]["home"]
    places = [f"{joint}={place}" for joint, place in zip(policy.metadata.joints, home, strict=True)]
    node = forged("inference_node", domain, policy_path=run / "policy.pt", autostart=True, goal=goal)
    robot = Process([sys.executable, str(Path(__file__).with_name("dds_peer.py")), str(domain), *places], domain)
    try:
        wait_for(lambda: robot.poll() is not None, 60.0, lambda: f"{robot.output}\n{node.output}")
        assert robot.wait() == 0, robot.output
        assert "rclpy" not in robot.output
        said = [line.split()[-1] for line in robot.lines if line.startswith("the node says")]
        assert said[-2:] == ["active", "reached"]
        position = [float(word) for word in robot.lines[-1].split("[")[1].rstrip("]").split(",")]
        assert policy.error(position, goal) < policy.metadata.tolerances[0].value
    finally:
        robot.end()
        node.end()


@pytest.mark.slow
def test_closes_the_loop_until_the_goal_is_reached(exported_run, domain):
    reach(exported_run, [0.1, 0.4], domain)


@pytest.mark.slow
def test_also_as_an_arm_with_seven_joints(panda_run, domain):
    reach(panda_run, [0.4, -0.2, 0.5], domain)
