"""Node and watchdog watch each other: the arm moves on only where both die at once."""

import signal
import time

import pytest
from std_msgs.msg import Float64MultiArray

from tests.ros.forge import forged
from tests.ros.loop import FAR, closed_loop
from tests.ros.peer import TOPIC, Peer
from tests.waiting import wait_for

WITHIN = 0.2  # s
NAME = "/command_watchdog"
SILENT = f"the watchdog {NAME} does not answer"


class Watched:
    """A loop with a watchdog in it; ``watchdog`` may be started again."""

    def __init__(self, loop):
        self.loop, self.peer, self.watchdog = loop, loop.peer, None
        self.watch()

    def watch(self):
        self.watchdog = forged("command_watchdog", self.peer.domain, joints=2)


@pytest.fixture(scope="module")
def watched(policy_path):
    # However long a busy machine takes until a new watchdog is there.
    with closed_loop(policy_path, watchdog=NAME, max_velocity=0.1, resume_timeout=10.0) as loop:
        made = Watched(loop)
        yield made
        made.watchdog.end()


def drive(watched):
    # What a test that failed may have left.
    watched.watchdog.signal(signal.SIGCONT)
    if watched.watchdog.poll() is not None:
        watched.watch()
    wait_for(lambda: watched.peer.call(f"{NAME}/reset").success, what="a watchdog without a conflict")
    watched.loop.rest()
    return watched.loop.start_from_here()


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
@pytest.mark.fault("watchdog silent for `watchdog_timeout` (0.1 s)")
def test_the_node_stops_the_arm_of_a_watchdog_that_hangs_or_dies_and_goes_on_when_it_is_back(watched, number):
    drive(watched)
    watched.peer.moved(after=time.monotonic(), commands=20)
    count = int(watched.loop.diagnosis()[2]["count: watchdog silences"])
    since = time.monotonic()
    watched.watchdog.signal(number)
    took = watched.peer.first_zeros(after=since)
    assert took < WITHIN
    watched.peer.all_zeros(after=since + took - 1e-6, commands=20)
    wait_for(lambda: SILENT in watched.loop.diagnosis()[1])
    assert int(watched.loop.diagnosis()[2]["count: watchdog silences"]) == count + 1
    back = time.monotonic()
    if number == signal.SIGSTOP:
        watched.watchdog.signal(signal.SIGCONT)
    else:
        watched.watchdog.wait()
        watched.watch()
    watched.peer.moved(after=back, commands=10)
    first = next(velocity for at, velocity in watched.peer.commands if at > back and any(velocity))
    assert max(map(abs, first)) <= 0.05  # two periods of the acceleration limit at most


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.fault("node silent for the watchdog's `timeout` (0.1 s)")
def test_the_watchdog_stops_the_arm_of_a_node_that_hangs(watched):
    drive(watched)
    since = time.monotonic()
    watched.loop.node.signal(signal.SIGSTOP)
    try:
        took = watched.peer.first_zeros(after=since)
        assert took < 0.15
        watched.peer.all_zeros(after=since + took - 1e-6, commands=20)
    finally:
        watched.loop.node.signal(signal.SIGCONT)
    watched.peer.moved(after=time.monotonic())


@pytest.mark.slow
@pytest.mark.fault("another publisher of commands")
def test_a_third_commander_is_a_rival_of_both(watched):
    drive(watched)
    other = Peer(watched.peer.domain)
    try:
        other.publisher(Float64MultiArray, TOPIC, 1)
        wait_for(lambda: f"another publisher commands {TOPIC}: peer" in watched.loop.diagnosis()[1])
        watched.watchdog.says(f"zero velocity: another publisher commands {TOPIC}: peer")
        watched.peer.all_zeros(after=time.monotonic())
    finally:
        other.close()
    # As long as the watchdog passes nothing on, a goal is no reason to find that the arm does not follow.
    wait_for(lambda: f"{SILENT}, or waits for its ~/reset" in watched.loop.diagnosis()[1])
    since = time.monotonic()
    watched.peer.send_goal(*FAR)
    watched.peer.all_zeros(after=since, commands=50)
    assert "fault" not in {state for at, state in watched.peer.states if at > since}
    wait_for(lambda: watched.peer.call(f"{NAME}/reset").success)
    drive(watched)


@pytest.mark.slow
def test_another_commander_of_the_watchdog_is_a_rival_of_the_node(watched):
    drive(watched)
    rival = watched.peer.node.create_publisher(Float64MultiArray, f"{NAME}/commands", 1)
    try:
        wait_for(lambda: f"another publisher commands {NAME}/commands: peer" in watched.loop.diagnosis()[1])
        watched.peer.all_zeros(after=time.monotonic() + 0.1)  # the last that moves comes by way of the watchdog
    finally:
        watched.peer.remove(rival)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_node_whose_watchdog_never_came_waits_without_a_word(policy_path):
    with closed_loop(policy_path, watchdog=NAME, goal=list(FAR)) as loop:
        wait_for(lambda: SILENT in loop.diagnosis()[1])
        loop.peer.silent(3.5)
        assert loop.peer.commands == []
        loop.peer.release_emergency_stop()  # so that the two have found each other
        since = time.monotonic()
        loop.peer.emergency_stop()  # this it says to the controller itself, once its watchdog has not answered
        assert loop.peer.first_zeros(after=since) < 2 * WITHIN


@pytest.mark.slow
def test_its_end_leaves_the_arm_standing_also_when_the_watchdog_has_just_stopped(policy_path):
    with closed_loop(policy_path, watchdog=NAME, goal=list(FAR)) as loop:
        watchdog = forged("command_watchdog", loop.peer.domain, joints=2)
        try:
            loop.peer.moved()
            watchdog.signal(signal.SIGSTOP)
            loop.node.signal(signal.SIGTERM)
            assert loop.node.wait() == 0
            loop.peer.silent()
            assert [velocity for _, velocity in loop.peer.commands][-5:] == [[0.0, 0.0]] * 5
        finally:
            watchdog.end()
