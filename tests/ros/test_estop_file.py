"""An emergency stop outlives the node that is in it."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from physai.ros.node import estop_file
from physai.ros.node.estop_file import EmergencyStopFile
from tests.ros.loop import FAR, closed_loop
from tests.waiting import wait_for

NODE = "/left/inference_node"


@pytest.fixture
def home(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "physai"


def closed(file: EmergencyStopFile) -> EmergencyStopFile:
    file.close(5.0)
    return file


def test_what_is_remembered_is_there_when_the_node_starts_again_until_it_is_forgotten(home):
    file = EmergencyStopFile(NODE, 7)
    assert (file.stopped, file.unusable) == (False, "")
    assert not file.pending
    file.remember()
    file.wait()
    assert not file.pending
    assert file.path == home / "domain_7.left.inference_node.estop"
    assert file.path.exists()
    closed(file)
    assert "emergency stop at 2" in file.path.read_text()
    again = EmergencyStopFile(NODE, 7)
    assert again.stopped
    again.forget()
    closed(again)
    assert not list(home.iterdir())
    assert not closed(EmergencyStopFile(NODE, 7)).stopped


def test_other_nodes_and_domains_have_files_of_their_own(home):
    closed(EmergencyStopFile(NODE, 7)).path.touch()
    assert not closed(EmergencyStopFile(NODE, 8)).stopped
    assert not closed(EmergencyStopFile("/right/inference_node", 7)).stopped


def test_the_last_wish_counts(home):
    file = EmergencyStopFile(NODE, 7)
    for _ in range(50):
        file.remember()
        file.forget()
    file.remember()
    closed(file)
    assert file.path.exists()


def test_it_is_kept_at_home_where_nothing_else_is_said(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    for given in ("", "relative"):
        monkeypatch.setenv("XDG_STATE_HOME", given)
        assert closed(EmergencyStopFile(NODE, 7)).path.parent == tmp_path / ".local" / "state" / "physai"


def test_where_nothing_can_be_written_it_says_so(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    (tmp_path / "file").touch()
    assert closed(EmergencyStopFile(NODE, 7)).unusable == f"{tmp_path / 'file' / 'physai'}: Not a directory"


@pytest.mark.slow
@pytest.mark.realtime
def test_a_disk_that_refuses_is_told_of_and_asked_again(home):
    file = EmergencyStopFile(NODE, 7)
    home.rmdir()
    home.touch()
    since = time.monotonic()
    file.remember()
    file.wait()
    assert time.monotonic() - since < 0.1
    wait_for(lambda: file.failures)
    assert "physai: " in file.failure
    home.unlink()
    wait_for(lambda: file.path.exists() and not file.failure)
    closed(file)


def test_a_change_that_half_succeeded_is_made_again(home, monkeypatch):
    file = EmergencyStopFile(NODE, 7)
    file.remember()
    wait_for(lambda: file._synced)
    sync = estop_file.sync_folder
    monkeypatch.setattr(
        estop_file, "sync_folder", lambda folder: (_ for _ in ()).throw(OSError(5, "Input/output error"))
    )
    file.forget()
    wait_for(lambda: file.failures)
    monkeypatch.setattr(estop_file, "sync_folder", sync)
    file.remember()  # the file has gone, and nobody knows whether for good
    closed(file)
    assert file.path.exists()


@pytest.mark.realtime
def test_a_disk_that_stands_still_keeps_nobody_waiting(home, monkeypatch):
    file, go = EmergencyStopFile(NODE, 7), threading.Event()
    monkeypatch.setattr("os.fsync", lambda _: go.wait(10.0))
    since = time.monotonic()
    file.remember()
    file.wait()
    file.forget()
    file.remember()
    file.wait()
    file.close(0.2)
    assert time.monotonic() - since < 0.5
    go.set()


@pytest.mark.slow
@pytest.mark.fault("emergency stop, then killed and started again")
def test_a_node_killed_in_an_emergency_stop_is_in_it_when_it_starts_again(policy_path, peer, tmp_path):
    with closed_loop(policy_path, peer=peer, state=tmp_path, goal=list(FAR)) as loop:
        peer.moved(after=time.monotonic())
        since = time.monotonic()
        peer.emergency_stop()
        peer.wait_state("estop", after=since)
        wait_for(lambda: list((tmp_path / "physai").glob("*.estop")), what="the file")  # a slow disk is not waited for
        loop.node.signal(signal.SIGKILL)
        loop.node.wait()
        loop.arm.leave()
    peer.commands.clear()
    peer.states.clear()
    with closed_loop(policy_path, peer=peer, state=tmp_path, goal=list(FAR)) as loop:
        peer.wait_state("estop")
        loop.node.says("emergency stop before this start")
        wait_for(lambda: len(peer.commands) > 180)  # longer than it looks for others
        assert not any(any(velocity) for _, velocity in peer.commands)
        assert {state for _, state in peer.states} == {"estop"}
        loop.node.says("stopped until ~/reset (")
        assert not peer.enable().success  # which takes no permission away
        assert peer.call("/inference_node/reset").success
        peer.wait_state("waiting")
        peer.send_goal(*FAR)
        peer.moved(after=time.monotonic())
    assert list((tmp_path / "physai").iterdir()) == []


@pytest.mark.slow
def test_a_node_that_is_ended_as_soon_as_its_zeros_have_come_remembers_the_stop(policy_path, peer, tmp_path):
    """What tells of it comes a tick after its zeros, and this one often never comes to that tick."""
    with closed_loop(policy_path, peer=peer, state=tmp_path, goal=list(FAR)) as loop:
        peer.moved(after=time.monotonic())
        peer.emergency_stop()
        wait_for(lambda: not any(peer.commands[-1][1]), what="zeros")
        loop.node.signal(signal.SIGTERM)
        assert loop.node.wait() == 0
    assert list((tmp_path / "physai").glob("*.estop"))


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs a folder that even root cannot write to")
@pytest.mark.fault("the folder for that cannot be written")
def test_without_a_place_to_remember_it_a_node_does_not_start_by_itself(policy_path):
    with closed_loop(policy_path, state=Path("/proc"), goal=list(FAR)) as loop:
        why = "not enabled: no autostart, as an emergency stop would not outlive it: /proc/physai: No such file"
        loop.node.says(why)
        wait_for(lambda: why in loop.diagnosis()[1])
        loop.peer.silent(3.5)
        assert loop.peer.commands == []
        wait_for(lambda: loop.peer.enable().success, what="permission, by somebody who has been told")
        loop.peer.moved()
        assert int(loop.diagnosis()[2]["count: emergency stop file failures"]) == 0
        loop.peer.call("/inference_node/estop")
        wait_for(lambda: int(loop.diagnosis()[2]["count: emergency stop file failures"]) > 0)
