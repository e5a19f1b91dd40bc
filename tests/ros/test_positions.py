"""An arm that takes positions: to stand still means to be told where it is, and nothing that is made up."""

import signal
import time
from array import array

import numpy as np
import pytest
from std_msgs.msg import Float64MultiArray

from physai.ros.topics.commands import controller_topic
from physai.signals import Quantity
from tests.ros.forge import forged
from tests.ros.peer import Peer
from tests.waiting import wait_for

TOPIC = f"/{controller_topic(Quantity.JOINT_POSITION)}"
ARM = {"overrides": "[env.robot.command=joint_position]"}


@pytest.fixture
def listener(domain):
    """A peer that hears commands of positions, ``peer.targets``, in the controller's place."""
    peer = Peer(domain, listen_to_commands=False)
    peer.targets = []
    peer.listen(Float64MultiArray, TOPIC, peer.targets, 1000, lambda message: message.data.tolist())
    yield peer
    peer.close()


@pytest.fixture
def run(domain):
    """Start nodes that end with the test."""
    nodes = []

    def start(name, *args, **parameters):
        nodes.append(forged(name, domain, *args, **parameters))
        return nodes[-1]

    yield start
    for node in nodes:
        node.end()


@pytest.mark.slow
def test_an_arm_that_was_never_heard_of_is_told_nothing_by_a_stop_or_an_end(listener, run, position_run):
    node = run("inference_node", policy_path=position_run / "policy.pt", autostart=True)
    wait_for(lambda: listener.states, what="the node")
    time.sleep(3.2)  # until it has looked for others, and would send
    assert listener.call("/inference_node/estop").success
    time.sleep(0.2)
    node.signal(signal.SIGTERM)
    node.wait(20)
    time.sleep(0.2)
    assert listener.targets == []


@pytest.mark.slow
def test_an_end_while_the_arm_moves_leaves_it_where_it_is(listener, run, position_run):
    run("virtual_robot", **ARM)
    node = run("inference_node", policy_path=position_run / "policy.pt", autostart=True, max_velocity=0.5)
    wait_for(lambda: listener.states, what="the node")
    listener.send_goal(-0.4, 0.1)
    listener.wait_state("active")
    wait_for(lambda: len(listener.targets) > 20 and np.ptp([q for _, q in listener.targets], axis=0).max() > 0.1)
    node.signal(signal.SIGTERM)
    node.wait(20)
    time.sleep(0.5)
    message = listener.joint_states[-1][1]
    assert np.abs(message.velocity).max() < 0.01
    np.testing.assert_allclose(listener.targets[-1][1], message.position, atol=0.01)
    moved = [at for at, state in listener.joint_states if np.abs(state.velocity).max() > 0.05]
    assert moved  # it had moved


@pytest.mark.slow
def test_a_watchdog_repeats_the_last_positions_and_makes_none_up(listener, run):
    run("command_watchdog", command="joint_position", joints=2, timeout=0.1)
    time.sleep(1.0)
    assert listener.targets == []

    def commanded():
        """Again and again: who publishes may know of a listener that does not know of it yet."""
        listener.publish("/command_watchdog/commands", Float64MultiArray(data=array("d", [0.3, -0.2])), 1)
        time.sleep(0.05)
        return listener.targets

    wait_for(commanded, what="commands")
    since = time.monotonic() + 0.3
    wait_for(lambda: listener.targets[-1][0] > since, what="the watchdog's own commands")
    assert all(target == [0.3, -0.2] for _, target in listener.targets)
