"""Whatever ends the inference node while the arm moves: the last command is zero."""

import contextlib
import signal
import time
from pathlib import Path

import pytest

from tests.ros.loop import FAR, closed_loop
from tests.ros.peer import TOPIC, Peer, node_command
from tests.waiting import wait_for

GOAL = "[-0.3, -0.2]"
ENDS = {
    "SIGINT": lambda loop: loop.node.signal(signal.SIGINT),
    "SIGINT, twice": lambda loop: [(loop.node.signal(signal.SIGINT), time.sleep(0.03)) for _ in range(2)],
    "SIGHUP": lambda loop: loop.node.signal(signal.SIGHUP),
    "SIGQUIT": lambda loop: loop.node.signal(signal.SIGQUIT),
    "SIGUSR1": lambda loop: loop.node.signal(signal.SIGUSR1),
    "the service": lambda loop: loop.peer.call("/inference_node/shutdown"),
}


def leaves_the_arm_standing(peer: Peer) -> None:
    """See that the commands end with zeros that came to a moving arm."""
    wait_for(lambda: not peer.node.count_publishers(TOPIC), what="an end of the publisher")
    peer.silent()
    commands = [velocity for _, velocity in peer.commands]
    assert any(map(any, commands[-30:])), f"the arm did not move at the end: {commands[-30:]}"
    assert commands[-5:] == [[0.0, 0.0]] * 5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 0), ("exception", 1)], ids=["SIGINT", "SIGTERM", "exception"]
)
def test_the_last_command_is_zero_five_times_of_five(policy_path, end, code):
    raising = end == "exception"
    module = "tests.ros.raising_node" if raising else "inference_node"
    with contextlib.ExitStack() as stack:
        loops = [stack.enter_context(closed_loop(policy_path, rate=50.0, module=module, goal=GOAL)) for _ in range(5)]
        for loop in loops:
            loop.peer.moved(after=time.monotonic())
            if raising:
                loop.peer.send_goal(*FAR)
            else:
                loop.node.signal(end)
        for loop in loops:
            assert loop.node.wait() == code, loop.node.output
            leaves_the_arm_standing(loop.peer)
            assert loop.node.output.count("Traceback") == code


@pytest.mark.slow
def test_the_last_command_is_zero(policy_path):
    with contextlib.ExitStack() as stack:
        loops = {name: stack.enter_context(closed_loop(policy_path, rate=50.0, goal=GOAL)) for name in ENDS}
        for name, loop in loops.items():
            loop.peer.moved(after=time.monotonic())
            ENDS[name](loop)
        for name, loop in loops.items():
            assert loop.node.wait() == 0, (name, loop.node.output)
            leaves_the_arm_standing(loop.peer)
            assert "Traceback" not in loop.node.output, name


@pytest.mark.slow
def test_a_node_that_never_had_a_say_ends_without_a_word(policy_path):
    with closed_loop(policy_path, autostart=False, goal=GOAL) as loop:
        loop.peer.wait_state("waiting")
        wait_for(lambda: len(loop.arm.sent) > 50)
        loop.node.signal(signal.SIGTERM)
        assert loop.node.wait() == 0
        loop.peer.silent()
        assert loop.peer.commands == []


@pytest.mark.slow
@pytest.mark.fault("Ctrl-C, Ctrl-Z, or any number of signals")
def test_a_storm_of_signals_ends_it_as_one_does(policy_path):
    with closed_loop(policy_path, goal=GOAL, finalize=True) as loop:
        loop.peer.moved(after=time.monotonic())
        while loop.node.poll() is None:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGTSTP):
                loop.node.signal(number)
            time.sleep(0.0002)
        assert loop.node.wait() == 0, loop.node.output
        leaves_the_arm_standing(loop.peer)
        assert "Traceback" not in loop.node.output


@pytest.mark.parametrize("library", ["librcl.so", "libtorch_cpu.so", "librmw_fastrtps_cpp.so"])
def test_a_signal_before_it_is_up_ends_it_without_a_traceback(start, policy_path, library):
    process = start.run(node_command("inference_node", policy_path=policy_path))
    wait_for(lambda: library in Path(f"/proc/{process.pid}/maps").read_text(), what=library)
    process.signal(signal.SIGINT)
    assert process.wait() in (0, -signal.SIGINT)
    assert "Traceback" not in process.output
