"""The watchdog between a node and a controller: commands pass, silence and nonsense become zeros."""

import math
import signal
import time
from array import array

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Empty, Float64MultiArray

from physai.ros.command_watchdog import CommandWatchdog
from tests.ros.forge import forged
from tests.ros.peer import TOPIC, Peer, free_domain
from tests.waiting import wait_for

TIMEOUT = 0.1  # s


@pytest.fixture(scope="module")
def watchdog():
    """A peer that sends to a watchdog, ``peer.process``, and hears what it passes on."""
    with free_domain() as domain:
        peer = Peer(domain)
        peer.process = forged("command_watchdog", domain, timeout=TIMEOUT)
        yield peer
        peer.process.end()
        peer.close()


def send(peer: Peer, *velocity: float) -> float:
    now = time.monotonic()
    peer.publish("/command_watchdog/commands", Float64MultiArray(data=array("d", velocity)), 1)
    return now


def passes(peer: Peer, *velocity: float) -> None:
    """Send until it is passed on (the first command may find no controller yet)."""

    def there() -> bool:
        send(peer, *velocity)
        return bool(peer.commands) and peer.commands[-1][1] == list(velocity)

    wait_for(there, what=f"{velocity} behind the watchdog")


@pytest.mark.slow
@pytest.mark.realtime
def test_silence_becomes_zeros_again_and_again(watchdog):
    for _ in range(5):
        passes(watchdog, 0.1, 0.2)
        since = send(watchdog, 0.1, 0.2)
        wait_for(lambda: watchdog.commands[-1][0] > since and any(watchdog.commands[-1][1]))  # noqa: B023
        assert TIMEOUT - 0.01 < watchdog.first_zeros(after=since) < TIMEOUT + 0.02 + 0.1  # a busy machine
        watchdog.all_zeros(after=since + TIMEOUT + 0.06, commands=10)


@pytest.mark.realtime
@pytest.mark.parametrize("nonsense", [(math.nan, 0.1), (0.1, math.inf), (0.1,), (0.1, 0.2, 0.3), ()])
def test_nonsense_becomes_zeros(watchdog, nonsense):
    passes(watchdog, 0.1, 0.2)
    since = send(watchdog, *nonsense)
    assert watchdog.first_zeros(after=since) < 0.05
    passes(watchdog, 0.1, 0.2)


@pytest.mark.slow
def test_another_commander_of_the_controller_stops_the_arm(watchdog):
    wait_for(lambda: watchdog.call("/command_watchdog/reset").success, what="a watchdog without a conflict")
    passes(watchdog, 0.1, 0.2)
    other = Peer(watchdog.domain)

    def stopped() -> bool:
        send(watchdog, 0.1, 0.2)
        time.sleep(0.02)
        return len(watchdog.commands) > 5 and not any(any(velocity) for _, velocity in watchdog.commands[-5:])

    try:
        other.publisher(Float64MultiArray, TOPIC, 1)
        wait_for(stopped, what="zeros while another one commands")
        watchdog.process.says(f"zero velocity: another publisher commands {TOPIC}: peer")
        assert not watchdog.call("/command_watchdog/reset").success
    finally:
        other.close()
    since = time.monotonic()
    while time.monotonic() < since + 0.5:  # it does not go on by itself
        send(watchdog, 0.1, 0.2)
        time.sleep(0.02)
    watchdog.all_zeros(after=since, commands=20)
    wait_for(lambda: watchdog.call("/command_watchdog/reset").success, what="a reset after the other one has left")
    passes(watchdog, 0.1, 0.2)


@pytest.mark.realtime
def test_who_commands_the_watchdog_may_stand_by_to_command_the_controller(watchdog):
    standby = watchdog.node.create_publisher(Float64MultiArray, TOPIC, 1)
    try:
        passes(watchdog, 0.1, 0.2)
        for _ in range(20):
            send(watchdog, 0.1, 0.2)
            time.sleep(0.02)
        assert watchdog.commands[-1][1] == [0.1, 0.2]
    finally:
        watchdog.remove(standby)
    assert watchdog.call("/command_watchdog/reset").success


@pytest.mark.slow
@pytest.mark.realtime
def test_its_heart_beats_as_often_as_it_looks_and_not_while_it_stands_still(watchdog):
    beats = []
    passes(watchdog, 0.1, 0.2)  # it hears somebody
    watchdog.listen(Empty, "/command_watchdog/heartbeat", beats, 10)
    wait_for(lambda: len(beats) > 50)
    assert 0.8 < beats[50][0] - beats[0][0] < 1.3
    watchdog.process.signal(signal.SIGSTOP)
    try:
        time.sleep(0.05)
        count = len(beats)
        time.sleep(0.2)
        assert len(beats) == count
    finally:
        watchdog.process.signal(signal.SIGCONT)
    wait_for(lambda: len(beats) > count + 5)


@pytest.mark.slow
@pytest.mark.realtime
def test_what_waited_while_the_watchdog_stood_still_is_not_passed_on(watchdog):
    for _ in range(3):
        passes(watchdog, 0.1, 0.2)
        watchdog.process.signal(signal.SIGSTOP)
        try:
            time.sleep(0.3)
            for _ in range(5):
                send(watchdog, 0.1, 0.2)
        finally:
            since = time.monotonic()
            watchdog.process.signal(signal.SIGCONT)
        wait_for(lambda: time.monotonic() > since + 0.3)  # noqa: B023
        after = [(at, any(velocity)) for at, velocity in watchdog.commands if at > since]
        moving = [at for at, moves in after if moves]
        assert len(moving) <= 1  # which it was just sending when it was stopped
        assert next(at for at, moves in after if not moves) - max([since, *moving]) < 0.05


@pytest.mark.slow
@pytest.mark.realtime
def test_a_command_that_has_waited_counts_from_when_it_came():
    with free_domain() as domain:
        peer = Peer(domain)
        rclpy.init(domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        node, executor = CommandWatchdog(), SingleThreadedExecutor()
        try:
            executor.add_node(node)
            node.set_parameters([Parameter("timeout", value=1.0)])

            def there() -> bool:
                if node.count_subscribers("/command_watchdog/commands"):
                    send(peer, 0.1, 0.2)
                executor.spin_once(0.02)
                return bool(peer.commands) and peer.commands[-1][1] == [0.1, 0.2]

            wait_for(there, what="a command behind the watchdog")
            since = send(peer, 0.1, 0.2)
            time.sleep(0.8)  # something else keeps the node busy
            while not any(at > since and not any(velocity) for at, velocity in peer.commands):
                executor.spin_once(0.02)
            assert 0.95 < peer.first_zeros(after=since) < 1.4
        finally:
            executor.shutdown()
            node.destroy_node()
            rclpy.shutdown()
            peer.close()


@pytest.mark.slow
def test_without_a_controller_it_listens_to_nobody():
    with free_domain() as domain:
        peer = Peer(domain, listen_to_commands=False)
        process = forged("command_watchdog", domain)
        try:
            publisher = peer.publisher(Float64MultiArray, "/command_watchdog/commands", 1)
            wait_for(lambda: "command_watchdog" in peer.node.get_node_names())
            time.sleep(0.5)
            assert publisher.get_subscription_count() == 0
            controller = peer.node.create_subscription(Float64MultiArray, TOPIC, lambda _: None, 1)
            wait_for(publisher.get_subscription_count, what="a watchdog that listens")
            peer.remove(controller)
            wait_for(lambda: not publisher.get_subscription_count(), what="a watchdog that listens no more")
        finally:
            process.end()
            peer.close()


@pytest.mark.slow
def test_with_a_number_of_joints_zeros_come_from_the_start():
    with free_domain() as domain:
        peer = Peer(domain)
        process = forged("command_watchdog", domain, joints=3)
        try:
            wait_for(lambda: len(peer.commands) > 5, what="zeros")
            assert {tuple(velocity) for _, velocity in peer.commands} == {(0.0, 0.0, 0.0)}
        finally:
            process.end()
            peer.close()


@pytest.mark.slow
@pytest.mark.parametrize("nonsense", [(), (math.nan, 0.1)])
def test_nonsense_does_not_tell_how_many_joints_there_are(nonsense):
    with free_domain() as domain:
        peer = Peer(domain)
        process = forged("command_watchdog", domain)
        try:
            send(peer, *nonsense)
            passes(peer, 0.1, 0.2)
            assert {len(velocity) for _, velocity in peer.commands} == {2}
        finally:
            process.end()
            peer.close()


@pytest.mark.realtime
def test_the_timeout_can_be_changed(watchdog):
    (answer,) = watchdog.set_parameters("/command_watchdog", timeout=0.4)
    assert answer.successful, answer.reason
    try:
        passes(watchdog, 0.1, 0.2)
        since = watchdog.commands[-1][0]
        assert 0.35 < watchdog.first_zeros(after=since) < 0.5
    finally:
        watchdog.set_parameters("/command_watchdog", timeout=TIMEOUT)


@pytest.mark.slow
def test_its_own_end_leaves_the_arm_standing():
    with free_domain() as domain:
        peer = Peer(domain)
        process = forged("command_watchdog", domain)
        try:
            passes(peer, 0.1, 0.2)
            process.signal(2)
            assert process.wait() == 0
            peer.silent()
            assert peer.commands[-1][1] == [0.0, 0.0]
        finally:
            process.end()
            peer.close()
