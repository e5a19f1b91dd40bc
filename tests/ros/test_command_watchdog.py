"""The watchdog between a node and a controller: commands pass, silence and nonsense become zeros."""

import math
import time
from array import array

import pytest
from std_msgs.msg import Float64MultiArray

from tests.ros.forge import forged
from tests.ros.peer import TOPIC, Peer, free_domain, wait_for

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


def test_silence_becomes_zeros_again_and_again(watchdog):
    for _ in range(5):
        passes(watchdog, 0.1, 0.2)
        since = send(watchdog, 0.1, 0.2)
        wait_for(lambda: watchdog.commands[-1][0] > since and any(watchdog.commands[-1][1]))  # noqa: B023
        assert TIMEOUT - 0.01 < watchdog.first_zeros(after=since) < TIMEOUT + 0.02 + 0.04
        watchdog.all_zeros(after=since + TIMEOUT + 0.06, commands=10)


@pytest.mark.parametrize("nonsense", [(math.nan, 0.1), (0.1, math.inf), (0.1,), (0.1, 0.2, 0.3), ()])
def test_nonsense_becomes_zeros(watchdog, nonsense):
    passes(watchdog, 0.1, 0.2)
    since = send(watchdog, *nonsense)
    assert watchdog.first_zeros(after=since) < 0.05
    passes(watchdog, 0.1, 0.2)


def test_another_commander_of_the_controller_stops_the_arm(watchdog):
    passes(watchdog, 0.1, 0.2)
    rival = watchdog.node.create_publisher(Float64MultiArray, TOPIC, 1)

    def stopped() -> bool:
        send(watchdog, 0.1, 0.2)
        time.sleep(0.02)
        return len(watchdog.commands) > 5 and not any(any(velocity) for _, velocity in watchdog.commands[-5:])

    wait_for(stopped, what="zeros while another one commands")
    watchdog.process.says(f"zero velocity: another publisher commands {TOPIC}: peer")
    watchdog.node.destroy_publisher(rival)
    passes(watchdog, 0.1, 0.2)


def test_the_timeout_can_be_changed(watchdog):
    (answer,) = watchdog.set_parameters("/command_watchdog", timeout=0.4)
    assert answer.successful, answer.reason
    try:
        passes(watchdog, 0.1, 0.2)
        since = watchdog.commands[-1][0]
        assert 0.35 < watchdog.first_zeros(after=since) < 0.5
    finally:
        watchdog.set_parameters("/command_watchdog", timeout=TIMEOUT)


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
