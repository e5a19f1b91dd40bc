"""When the arm must not move though nothing is wrong with it: another commander, no controller, no permission."""

import contextlib
import time
from collections.abc import Iterator

import pytest
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray

from tests.ros.loop import FAR, Loop, closed_loop
from tests.ros.peer import TOPIC, Peer, free_domain
from tests.waiting import wait_for

WITHIN = 0.15  # s
GOAL = list(FAR)


@pytest.fixture
def rival(peer):
    """A publisher of commands that says nothing; ``rival.leave()``."""
    publisher = peer.node.create_publisher(Float64MultiArray, TOPIC, 1)
    publisher.leave = lambda: peer.remove(publisher)
    return publisher


@contextlib.contextmanager
def rival_of(peer: Peer) -> Iterator[None]:
    """A publisher of commands that says nothing, and leaves in the end."""
    publisher = peer.node.create_publisher(Float64MultiArray, TOPIC, 1)
    try:
        yield
    finally:
        peer.remove(publisher)


def waits_because_of(loop: Loop, text: str) -> None:
    wait_for(lambda: text in loop.diagnosis()[1], what=lambda: f"{text!r}; {loop.diagnosis()[1]}")
    loop.peer.wait_state("waiting")  # a busy machine may make it hold in between


@pytest.mark.slow
def test_another_commander_from_before_the_start_is_not_disturbed(policy_path, rival, peer):
    with closed_loop(policy_path, peer=peer, goal=GOAL) as loop:
        waits_because_of(loop, f"another publisher commands {TOPIC}: peer")
        assert peer.enable().success is False
        assert peer.commands == []
        rival.leave()
        wait_for(lambda: peer.enable().success, what="permission after the other one has left")
        peer.moved()


@pytest.mark.slow
@pytest.mark.fault("another publisher of commands")
def test_another_commander_that_appears_ends_the_motion_for_good(loop):
    loop.start()
    with rival_of(loop.peer):
        created = time.monotonic()
        waits_because_of(loop, f"another publisher commands {TOPIC}: peer")
        assert time.monotonic() - created < 5.0
        loop.peer.all_zeros(after=time.monotonic())
        since = time.monotonic()
    waits_because_of(loop, "no goal yet")
    loop.peer.all_zeros(after=since, commands=40)
    loop.peer.send_goal(*FAR)
    loop.peer.moved(after=since)


@pytest.mark.slow
def test_a_goal_sent_while_another_one_commands_is_not_kept(loop):
    loop.start()
    with rival_of(loop.peer):
        waits_because_of(loop, f"another publisher commands {TOPIC}: peer")
        loop.peer.send_goal(*FAR)
        for _ in range(2):
            loop.diagnosis()  # it has ticked since
        since = time.monotonic()
    waits_because_of(loop, "no goal yet")
    loop.peer.all_zeros(after=since, commands=20)


@pytest.mark.slow
def test_to_disable_it_leaves_zeros_also_when_another_one_has_just_come(loop):
    for wait in (0.0, 0.03, 0.06, 0.09, 0.12):
        loop.start()
        with rival_of(loop.peer):
            time.sleep(wait)
            assert loop.peer.enable(False).success
            loop.peer.silent()
            assert loop.peer.commands[-1][1] == [0.0, 0.0]
        wait_for(lambda: loop.peer.enable().success, what="permission to move")


@pytest.mark.slow
def test_nothing_moves_without_a_controller_that_listens(policy_path):
    with free_domain() as domain:
        peer = Peer(domain, listen_to_commands=False)
        try:
            with closed_loop(policy_path, peer=peer, goal=GOAL) as loop:
                waits_because_of(loop, f"no controller listens to {TOPIC}")
                assert peer.enable().message == f"no controller listens to {TOPIC}"
                since = time.monotonic()
                peer.listen(Float64MultiArray, TOPIC, peer.commands, 1000, lambda message: message.data.tolist())
                wait_for(lambda: peer.enable().success, what="permission to move")
                peer.moved(after=since)
        finally:
            peer.close()


@pytest.mark.slow
@pytest.mark.fault(
    "commands do not reach the robot (no controller listens, the watchdog is silent) for longer than "
    "`resume_timeout` (1 s)"
)
def test_a_controller_that_leaves_and_returns_stops_the_arm_in_between(policy_path):
    with free_domain() as domain:
        peer = Peer(domain, listen_to_commands=False)
        try:
            with closed_loop(policy_path, peer=peer, goal=GOAL, resume_timeout=10.0) as loop:

                def listen():
                    return peer.listen(
                        Float64MultiArray, TOPIC, peer.commands, 1000, lambda message: message.data.tolist()
                    )

                for _ in range(2):
                    listener = listen()
                    peer.moved(after=time.monotonic())
                    peer.remove(listener)
                    waits_because_of(loop, f"no controller listens to {TOPIC}")
                # One that was away for longer may have been switched off, and the arm led elsewhere.
                peer.set_parameters("/inference_node", resume_timeout=0.5)
                loop.node.says("goal forgotten: commands have not reached the robot for 0.5 s")
                since = time.monotonic()
                listen()
                wait_for(lambda: loop.diagnosis()[1].endswith("no goal yet"), what="a wait for a goal")
                peer.all_zeros(after=since, commands=30)
                loop.start_from_here()
        finally:
            peer.close()


@pytest.mark.slow
@pytest.mark.realtime
def test_it_drives_only_after_enable_unless_told_to_start_by_itself(policy_path):
    with closed_loop(policy_path, autostart=False, goal=GOAL) as loop:
        waits_because_of(loop, "not enabled")
        assert loop.diagnosis()[2]["enabled"] == "False"
        assert loop.peer.commands == []
        wait_for(lambda: loop.peer.enable().success, what="permission to move")
        loop.peer.moved()
        since = time.monotonic()
        answer = loop.peer.enable(False)
        assert (answer.success, answer.message) == (True, "disabled: the arm stands")
        assert loop.peer.first_zeros(after=since) < 0.05
        loop.peer.all_zeros(after=since + 0.05, commands=30)
        since = time.monotonic()
        answer = loop.peer.enable()  # the goal is still there: who enables says go
        assert (answer.success, answer.message) == (True, "enabled")
        loop.peer.moved(after=since)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_clock_of_a_simulation_that_stands_still_or_is_missing_changes_nothing(policy_path):
    with closed_loop(policy_path, use_sim_time=True, goal=GOAL) as loop:
        for clock in (None, 5, 5, 7):
            if clock is not None:
                loop.peer.publish("/clock", Clock(clock=Clock().clock.__class__(sec=clock)))
            loop.peer.moved(after=time.monotonic(), commands=20)
            since = loop.arm.pause()
            assert loop.peer.first_zeros(after=since) < WITHIN
            loop.peer.all_zeros(after=since + WITHIN)
            loop.arm.go_home()
