"""The emergency stop: by service and by topic, at once, until a reset."""

import time

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool, String

from physai.ros.topics import qos
from physai.ros.topics.emergency_stop import EmergencyStopTopic
from tests.ros.loop import FAR, closed_loop
from tests.ros.peer import Peer
from tests.waiting import wait_for

WITHIN = 0.02 + 0.03  # s: a period, and what the transport and a busy machine may take
PROFILES = {
    "best effort": QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
    "reliable": QoSProfile(depth=10),
    "latched": QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    "latched, best effort": QoSProfile(
        depth=1, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.TRANSIENT_LOCAL
    ),
}


@pytest.fixture(scope="module")
def loop(policy_path):
    with closed_loop(policy_path) as loop:
        for profile in PROFILES.values():  # early enough to be known when they matter
            loop.peer.publisher(Bool, "/emergency_stop", profile)
        yield loop


@pytest.fixture(autouse=True)
def _released(request):
    """What a test has latched does not hold the stop of the next one."""
    yield
    if "loop" in request.fixturenames:
        request.getfixturevalue("loop").peer.publisher(Bool, "/emergency_stop", PROFILES["latched"]).publish(Bool())


def stays_stopped(loop, since: float) -> None:
    """Latched: neither a new goal nor ~/enable end it; and a late joiner is told."""
    loop.peer.wait_state("estop")
    loop.peer.send_goal(*FAR)
    loop.peer.all_zeros(after=since + WITHIN)
    late = {"state": [], "estopped": []}
    loop.peer.listen(String, "/inference_node/state", late["state"], qos.LATCHED, lambda message: message.data)
    loop.peer.listen(Bool, "/inference_node/estopped", late["estopped"], qos.LATCHED, lambda message: message.data)
    wait_for(lambda: late["state"] and late["estopped"], what="the latched state")
    assert (late["state"][0][1], late["estopped"][0][1]) == ("estop", True)


@pytest.mark.slow
@pytest.mark.realtime
def test_the_service_stops_the_arm_at_once_and_for_good(loop):
    for _ in range(5):
        loop.start()
        since = time.monotonic()
        answer = loop.peer.call("/inference_node/estop")
        assert loop.peer.first_zeros(after=since) < WITHIN
        assert answer.success
        assert answer.message == "stopped until ~/reset"
    stays_stopped(loop, since)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_a_false_that_follows_at_once_does_not_undo_it(loop, profile):
    other = loop.peer.publisher(Bool, "/emergency_stop", PROFILES["reliable"])
    for _ in range(10):
        loop.start()
        publisher = loop.peer.publisher(Bool, "/emergency_stop", profile)
        since = time.monotonic()
        publisher.publish(Bool(data=True))
        other.publish(Bool(data=False))
        publisher.publish(Bool(data=False))
        assert loop.peer.first_zeros(after=since) < WITHIN
        loop.peer.wait_state("estop")


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_a_message_of_every_quality_of_service_stops_the_arm_at_once(loop, profile):
    loop.start()
    since = time.monotonic()
    loop.peer.publish("/emergency_stop", Bool(data=True), profile)
    assert loop.peer.first_zeros(after=since) < WITHIN
    stays_stopped(loop, since)


@pytest.mark.slow
def test_only_a_reset_ends_it_and_the_goal_is_forgotten(loop):
    since = loop.start()
    loop.peer.call("/inference_node/estop")
    assert "call ~/reset first" in loop.peer.enable().message
    answer = loop.peer.call("/inference_node/reset")
    assert answer.message.startswith("waiting for a new goal")
    since = time.monotonic()
    loop.peer.wait_state("waiting")
    loop.peer.all_zeros(after=since, commands=30)
    assert loop.diagnosis()[2]["goal"] == ""
    assert loop.peer.enable().success
    loop.peer.send_goal(*FAR)
    loop.peer.moved(after=since)


@pytest.mark.slow
@pytest.mark.realtime
def test_false_neither_stops_the_arm_nor_ends_a_stop(loop):
    since = loop.start()
    for profile in PROFILES.values():
        loop.peer.publish("/emergency_stop", Bool(data=False), profile)
    loop.peer.moved_on(after=time.monotonic(), commands=20)
    assert "estop" not in {state for at, state in loop.peer.states if at > since}  # it may hold, on a busy machine
    loop.peer.call("/inference_node/estop")
    since, _ = loop.peer.wait_state("estop")
    for profile in PROFILES.values():
        loop.peer.publish("/emergency_stop", Bool(data=False), profile)
    loop.peer.all_zeros(after=since, commands=20)
    assert loop.peer.states[-1][1] == "estop"


@pytest.mark.slow
def test_one_that_was_pressed_before_the_node_started_counts(policy_path, peer):
    peer.publisher(Bool, "/emergency_stop", PROFILES["latched"]).publish(Bool(data=True))
    with closed_loop(policy_path, peer=peer, goal="[-0.3, -0.2]") as loop:
        loop.peer.wait_state("estop")
        loop.peer.all_zeros(after=0.0, commands=30)
        answer = loop.peer.call("/inference_node/reset")
        assert (answer.success, answer.message) == (False, "/emergency_stop is still true, latched: peer")
        loop.peer.publish("/emergency_stop", Bool(data=False), PROFILES["latched"])
        wait_for(lambda: loop.peer.call("/inference_node/reset").success, what="a reset")
        loop.peer.wait_state("waiting")
        loop.peer.send_goal(*FAR)
        loop.peer.moved()


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.fault("latched `/emergency_stop` is still true")
def test_a_reset_is_refused_while_one_of_two_latched_stops_is_still_pressed(loop):
    other = Peer(loop.peer.domain)
    try:
        loop.start()
        ours, theirs = (peer.publisher(Bool, "/emergency_stop", PROFILES["latched"]) for peer in (loop.peer, other))
        wait_for(lambda: theirs.get_subscription_count() >= 3)
        ours.publish(Bool(data=True))
        loop.peer.wait_state("estop")
        theirs.publish(Bool(data=True))
        theirs.publish(Bool(data=False))
        time.sleep(0.1)
        since = time.monotonic()
        while time.monotonic() < since + 1.2:
            answer = loop.peer.call("/inference_node/reset")
            assert not answer.success
            assert "/emergency_stop is still true" in answer.message
            time.sleep(0.1)
        ours.publish(Bool(data=False))
        wait_for(lambda: loop.peer.call("/inference_node/reset").success, 5.0, "a reset once both are released")
        theirs.publish(Bool(data=True))
        loop.peer.wait_state("estop")
        assert not loop.peer.call("/inference_node/reset").success
    finally:
        other.close()
    wait_for(lambda: loop.peer.call("/inference_node/reset").success, 10.0, "a reset once the pressed one has left")


def test_a_false_does_not_take_away_the_true_of_another_button(peer):
    """As they come when both are asked again: A has said false and true, B false, true and false."""
    topic = EmergencyStopTopic(peer.node, lambda: None)
    peer.publisher(Bool, "/emergency_stop", PROFILES["latched"])
    other = peer.node.create_publisher(Bool, "/emergency_stop", PROFILES["latched"])
    wait_for(lambda: len(topic._latching()) == 2)
    topic._last.clear()
    topic._take_latched(Bool(data=True), {"publication_sequence_number": 2})
    topic._take_latched(Bool(data=False), {"publication_sequence_number": 3})
    assert "is still true" in topic.held()
    peer.remove(other)


def test_without_numbers_a_true_holds_until_all_are_asked_again(peer):
    topic = EmergencyStopTopic(peer.node, lambda: None)
    peer.publisher(Bool, "/emergency_stop", PROFILES["latched"]).publish(Bool())
    wait_for(lambda: topic._latching() and topic._last)
    for pressed in (False, True, False):
        topic._take_latched(Bool(data=pressed), {"publication_sequence_number": None})
    assert "is still true" in topic.held()
    wait_for(lambda: topic.held() is None, what="their answers")


@pytest.mark.slow
def test_a_true_that_is_not_latched_does_not_hold_the_stop(loop):
    loop.start()
    loop.peer.publish("/emergency_stop", Bool(data=True), PROFILES["reliable"])
    loop.peer.wait_state("estop")
    assert loop.peer.call("/inference_node/reset").success


@pytest.mark.slow
def test_it_is_taken_without_a_robot_and_without_being_enabled(policy_path):
    with closed_loop(policy_path, autostart=False) as loop:
        loop.arm.change = lambda message: None
        loop.peer.emergency_stop()
        loop.peer.wait_state("estop")
        loop.peer.all_zeros(after=0.0)
