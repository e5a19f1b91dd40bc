"""Whatever becomes of its output, a node acts: a terminal that was stopped, a pipe unread, a full disk, none at all."""

import contextlib
import math
import os
import pty
import shlex
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from geometry_msgs.msg import PointStamped

from tests.ros.forge import forged
from tests.ros.loop import FAR, closed_loop
from tests.ros.peer import Peer, free_domain, node_command
from tests.ros.test_command_watchdog import passes
from tests.ros.test_record import KINDS, numbers, send_numbers
from tests.waiting import wait_for

WITHIN = 0.15  # s

TALKER = """
import sys, time
from physai.ros.node import outlet
with outlet.outlets():
    longest = 0.0
    for number in range({lines}):
        began = time.monotonic()
        print("line", number, "x" * 100)
        longest = max(longest, time.monotonic() - began)
        time.sleep(0.0002)
    time.sleep(0.1)  # until they are counted
    with open({report!r}, "w") as file:
        file.write(f"{{longest}} {{outlet.dropped_lines()}}")
    time.sleep({wait})
    print("the last line")
    print("an error", file=sys.stderr)
    raise SystemExit(3)
"""


@contextlib.contextmanager
def stopped_terminal() -> Iterator[Path]:
    """As after Ctrl-S."""
    leader, follower = pty.openpty()
    termios.tcflow(follower, termios.TCOOFF)
    yield Path(os.ttyname(follower))
    os.close(leader)
    os.close(follower)


@contextlib.contextmanager
def unread_pipe(folder: Path) -> Iterator[Path]:
    """Full already."""
    path = folder / "pipe"
    os.mkfifo(path)
    pipe = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(pipe, b"x")
    yield path
    os.close(pipe)


@contextlib.contextmanager
def blocked(kind: str, folder: Path) -> Iterator[Path]:
    if kind == "full disk":
        yield Path("/dev/full")
    else:
        with stopped_terminal() if kind == "terminal" else unread_pipe(folder) as path:
            yield path


def talk(lines: int, folder: Path, wait: float, **streams: int) -> tuple[subprocess.Popen[bytes], Path]:
    report = folder / "report"
    code = TALKER.format(lines=lines, wait=wait, report=str(report))
    return subprocess.Popen([sys.executable, "-c", code], **streams), report


@pytest.mark.slow
@pytest.mark.realtime
def test_lines_that_nobody_takes_are_counted_and_told_of_when_they_flow_again(tmp_path):
    reader, writer = os.pipe()
    process, report = talk(3000, tmp_path, 1.0, stdout=writer, stderr=writer)
    os.close(writer)
    wait_for(lambda: report.exists() and report.read_text())
    longest, dropped = map(float, report.read_text().split())
    assert longest < 0.05
    assert dropped > 500
    with os.fdopen(reader) as file:
        shown = file.read().splitlines()
    assert process.wait(10) == 3
    assert shown[0].startswith("line 0 ")
    assert shown[-2:] == ["the last line", "an error"]
    assert f"[WARN] {dropped:.0f} lines of this output are missing here: they were not taken in time" in shown
    assert sum(line.startswith("line ") for line in shown) + dropped == 3000


def test_a_full_disk_and_a_reader_that_has_gone_lose_lines_and_nothing_else(tmp_path):
    with open("/dev/full", "w") as full:
        process, report = talk(50, tmp_path, 0.1, stdout=full, stderr=full)
    assert process.wait(10) == 3
    reader, writer = os.pipe()
    os.close(reader)
    process, report = talk(50, tmp_path, 0.1, stdout=writer, stderr=writer)
    os.close(writer)
    assert process.wait(10) == 3
    assert float(report.read_text().split()[1]) > 40


@pytest.mark.realtime
def test_an_end_waits_half_a_second_for_output_that_does_not_flow(tmp_path):
    with unread_pipe(tmp_path) as path, open(path, "r+b", buffering=0) as pipe:
        process, report = talk(10, tmp_path, 0.0, stdout=pipe, stderr=pipe)
        wait_for(lambda: report.exists() and report.read_text())
        since = time.monotonic()
        assert process.wait(10) == 3
        assert time.monotonic() - since < 1.5


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("kind", "reasons"),
    [
        ("terminal", ["service", "topic", "not finite", "silence"]),
        ("pipe", ["topic"]),
        ("full disk", ["topic"]),
    ],
)
@pytest.mark.fault("output stopped, full or closed")
def test_a_node_stops_the_arm_all_the_same(policy_path, tmp_path, kind, reasons):
    with blocked(kind, tmp_path) as output, closed_loop(policy_path, output=output) as loop:
        loop.start()
        loop.peer.release_emergency_stop()  # so that the two have found each other
        bad = PointStamped()
        bad.header.frame_id = "nowhere" * 1000  # a long line
        for _ in range(100):
            loop.peer.publish("/inference_node/goal", bad)
            time.sleep(0.01)
        for reason in reasons:
            loop.start()
            since = time.monotonic()
            if reason == "service":
                loop.peer.call("/inference_node/estop")
            elif reason == "topic":
                loop.peer.emergency_stop()
            elif reason == "not finite":
                loop.arm.change = lambda message: setattr(message, "position", [math.nan] * 2) or message
            else:
                since = loop.arm.pause()
            assert loop.peer.first_zeros(after=since) < WITHIN, reason
        loop.start()
        assert int(loop.diagnosis()[2]["log lines dropped"]) > 0
        since = time.monotonic()
        loop.node.signal(signal.SIGTERM)
        assert loop.peer.first_zeros(after=since) < WITHIN
        assert loop.node.wait() == 0
        assert time.monotonic() - since < 4.0


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("kind", ["terminal", "pipe"])
@pytest.mark.fault("output stopped, full or closed")
def test_a_watchdog_stops_the_arm_all_the_same(tmp_path, kind):
    with blocked(kind, tmp_path) as output, free_domain() as domain:
        peer = Peer(domain)
        process = forged("command_watchdog", domain, output=output, joints=2)
        try:
            for _ in range(3):
                passes(peer, 0.1, 0.2)
                since = peer.commands[-1][0]
                assert peer.first_zeros(after=since) < WITHIN
        finally:
            process.end()
            peer.close()


@pytest.mark.slow
def test_a_recorder_goes_on_recording(tmp_path):
    bag = tmp_path / "bag"
    with blocked("terminal", tmp_path) as output, free_domain() as domain:
        peer = Peer(domain)
        process = forged("record", domain, "-p", f"output:={bag}", output=output, topics="[/numbers]")
        try:
            send_numbers(peer, 300, KINDS["reliable"])
            process.signal(signal.SIGINT)
            assert process.wait() == 0
        finally:
            process.end()
            peer.close()
    assert numbers(bag) == list(range(300))


@pytest.mark.slow
@pytest.mark.fault("output stopped, full or closed")
def test_a_closed_error_output_is_no_socket_of_the_middleware(start, peer, policy_path):
    command = shlex.join(node_command("inference_node", policy_path=policy_path, autostart=True, goal=list(FAR)))
    process = start.run(["bash", "-c", f"exec {command} 0<&- 2>&-"])
    wait_for(lambda: "inference_node" in peer.node.get_node_names())
    files = [os.readlink(f"/proc/{process.pid}/fd/{number}") for number in (0, 1, 2)]
    assert files[0] == "/dev/null"
    assert all(name.startswith("pipe:") for name in files[1:])  # outlets
    process.signal(signal.SIGTERM)
    assert process.wait() == 0
    assert process.output == ""
