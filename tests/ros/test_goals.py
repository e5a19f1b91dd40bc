"""Goals: which are taken, and what is said about the others."""

import math
import time

import pytest
from geometry_msgs.msg import PoseStamped

from tests.ros.loop import FAR, closed_loop
from tests.ros.peer import Peer
from tests.waiting import wait_for

BAD = {
    "of another frame": ((0.3, 0.3, "world"), "goal rejected: frame 'world' is not 'base'"),
    "without a frame": ((0.3, 0.3, ""), "goal rejected: frame '' is not 'base'"),
    "too far": ((3.0, 0.0), "goal rejected: 3.000 m from the base, not 0.3 to 0.53"),
    "too near": ((0.05, 0.0), "goal rejected: 0.050 m from the base, not 0.3 to 0.53"),
    "NaN": ((math.nan, 0.3), "goal rejected: it is not finite"),
    "infinite": ((0.3, -math.inf), "goal rejected: it is not finite"),
}


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("name", BAD)
def test_a_bad_goal_is_refused_with_a_reason_and_the_old_one_stays(loop, name):
    goal, reason = BAD[name]
    since = loop.start()
    lines = len(loop.node.lines)
    loop.peer.send_goal(*goal)
    wait_for(lambda: any(reason in line and "WARN" in line for line in loop.node.lines[lines:]), what=reason)
    loop.peer.moved(after=time.monotonic(), commands=20)
    assert all(any(velocity) for at, velocity in loop.peer.commands if at > since)
    assert loop.diagnosis()[2]["goal"] == str(list(FAR))


@pytest.mark.slow
def test_a_bad_goal_does_not_start_the_arm(loop):
    loop.rest()
    since = time.monotonic()
    for goal, _ in BAD.values():
        loop.peer.send_goal(*goal)
    loop.peer.all_zeros(after=since, commands=20)
    assert loop.diagnosis()[2]["goal"] == ""


@pytest.mark.slow
def test_goals_of_another_type_do_not_arrive_and_are_named(loop):
    loop.rest()
    other = Peer(loop.peer.domain, listen_to_commands=False)  # one process cannot have a topic with two types
    other.publisher(PoseStamped, "/inference_node/goal")
    said = "goals of this policy are a PointStamped; unheard on /inference_node/goal: geometry_msgs/msg/PoseStamped"
    try:
        wait_for(lambda: any(said in line and "WARN" in line for line in loop.node.lines), what=said)
        wait_for(lambda: loop.diagnosis()[2].get("goals of another type") == said, what=said)
    finally:
        other.close()
    wait_for(lambda: "goals of another type" not in loop.diagnosis()[2], what="no publisher of poses")


@pytest.mark.slow
def test_a_goal_out_of_reach_is_moved_to_the_nearest_where_that_is_allowed(loop):
    loop.rest()
    (answer,) = loop.peer.set_parameters("/inference_node", unreachable_goal="project")
    assert answer.successful, answer.reason
    try:
        loop.peer.send_goal(-3.0, 0.0)
        loop.node.says("goal out of reach: [-0.53, 0.0] is the nearest in reach")
        loop.peer.moved(after=time.monotonic())
        assert loop.diagnosis()[2]["goal"] == "[-0.53, 0.0]"
    finally:
        loop.peer.set_parameters("/inference_node", unreachable_goal="reject")


@pytest.mark.slow
def test_a_goal_given_as_parameter_is_moved_into_reach_too(policy_path):
    with closed_loop(policy_path, goal=[-3.0, 0.0], unreachable_goal="project") as loop:
        loop.peer.moved()
        assert loop.diagnosis()[2]["goal"] == "[-0.53, 0.0]"


@pytest.mark.slow
def test_only_the_last_of_many_goals_counts(loop):
    loop.rest()
    for angle in range(0, 360, 10):
        loop.peer.send_goal(0.4 * math.cos(math.radians(angle)), 0.4 * math.sin(math.radians(angle)))
    loop.peer.send_goal(0.4, 0.1)
    loop.peer.wait_state("reached")
    assert loop.diagnosis()[2]["goal"] == "[0.4, 0.1]"
    reached = time.monotonic()
    loop.peer.all_zeros(after=reached, commands=20)
