"""Processes that stand still or die: robot, node, and what is left to stop the arm."""

import signal
import time

import pytest

from tests.ros.loop import FAR, closed_loop
from tests.waiting import wait_for

WITHIN = 0.15  # s


@pytest.fixture
def driven(start, peer, policy_path):
    """The virtual robot under the inference node, on a long way; returns both processes."""

    def drive(*args, robot=None, **parameters):
        processes = (
            start("virtual_robot", **(robot or {})),
            start("inference_node", *args, policy_path=policy_path, autostart=True, **parameters),
        )
        peer.send_goal(*FAR)
        peer.moved()
        return processes

    return drive


def speeds(peer, after):
    return [(at, max(map(abs, message.velocity))) for at, message in list(peer.joint_states) if at > after]


@pytest.mark.realtime
@pytest.mark.slow
def test_a_robot_that_stands_still_and_one_that_dies(driven, start, peer):
    robot, _ = driven()
    took = []
    for _ in range(10):
        robot.signal(signal.SIGSTOP)
        since = time.monotonic()
        took.append(peer.first_zeros(after=since))
        peer.all_zeros(after=since + took[-1], commands=20)
        assert peer.states[-1][1] == "hold"
        robot.signal(signal.SIGCONT)  # it goes on by itself
        peer.wait_state("active", after=since)
        peer.moved(after=time.monotonic())
    assert max(took) < WITHIN, took
    robot.signal(signal.SIGKILL)
    since = time.monotonic()
    delay = peer.first_zeros(after=since)
    assert delay < WITHIN
    peer.all_zeros(after=since + delay, commands=20)
    start("virtual_robot")  # at home, not where the other one died
    came = time.monotonic()
    peer.wait_state("waiting", after=came)
    peer.all_zeros(after=since + delay, commands=20)
    peer.send_goal(*FAR)
    peer.wait_state("active", after=came)
    peer.moved(after=time.monotonic(), commands=20)


@pytest.mark.realtime
@pytest.mark.slow
def test_a_node_that_stood_still_sends_zeros_first_and_no_burst(driven, peer):
    _, node = driven(resume_timeout=10.0)
    for _ in range(3):
        node.signal(signal.SIGSTOP)
        peer.silent(1.0)
        since = time.monotonic()
        node.signal(signal.SIGCONT)
        wait_for(lambda: time.monotonic() > since + 0.3)  # noqa: B023
        commands = [(at, velocity) for at, velocity in peer.commands if at > since]
        assert commands[0][1] == [0.0, 0.0]
        assert len([at for at, _ in commands if at < commands[0][0] + 0.1]) <= 7, commands
        peer.moved(after=since)


@pytest.mark.slow
def test_after_a_killed_node_a_faithful_robot_moves_on_and_on(driven, peer):
    _, node = driven(resume_timeout=10.0)

    def stands_still_while_the_arm_moves():
        node.signal(signal.SIGSTOP)
        peer.silent()
        if max(map(abs, peer.commands[-1][1])) > 0.05:
            return True
        since = time.monotonic()  # its last tick was a late one, and the arm stands
        node.signal(signal.SIGCONT)
        peer.moved(after=since)
        return False

    wait_for(stands_still_while_the_arm_moves)
    node.signal(signal.SIGKILL)
    node.wait()
    since = time.monotonic()
    wait_for(lambda: time.monotonic() > since + 1.5)
    assert min(speed for _, speed in speeds(peer, since)) > 0.01


@pytest.mark.realtime
@pytest.mark.slow
@pytest.mark.parametrize("timeout", [0.1, 0.3])
def test_a_watchdog_between_stops_the_arm_of_a_killed_node(driven, start, peer, timeout):
    start("command_watchdog", timeout=timeout)
    _, node = driven(watchdog="/command_watchdog")
    node.signal(signal.SIGKILL)
    since = time.monotonic()
    took = peer.first_zeros(after=since)
    assert timeout - 0.03 < took < timeout + 0.05  # a command may have been a period old
    wait_for(lambda: speeds(peer, since) and speeds(peer, since)[-1][1] < 1e-3, 1.0, "an arm that stands")
    peer.all_zeros(after=since + took, commands=20)


@pytest.mark.realtime
@pytest.mark.slow
def test_a_robot_with_a_command_timeout_stops_without_its_node(driven, peer):
    _, node = driven(robot={"command_timeout": 0.2})
    node.signal(signal.SIGKILL)
    since = time.monotonic()
    last = peer.commands[-1][0]
    stands = wait_for(lambda: next((at for at, speed in speeds(peer, since) if speed < 1e-3), None), 5.0)
    assert 0.15 < stands - last < 0.3


@pytest.mark.slow
@pytest.mark.realtime
def test_a_paused_robot_of_this_process_stops_the_arm_within_the_timeout(policy_path):
    with closed_loop(policy_path, goal=list(FAR)) as loop:
        for _ in range(10):
            loop.peer.moved(after=time.monotonic())
            since = loop.arm.pause()
            assert 0.08 < loop.peer.first_zeros(after=since) < WITHIN
            loop.arm.go_home()
