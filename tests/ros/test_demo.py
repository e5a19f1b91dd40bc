"""The demo: both nodes, goal after goal, and a picture."""

import contextlib
import os
import signal
import sys
from pathlib import Path

import imageio.v3 as imageio
import pytest

from tests.ros.peer import Peer, Process
from tests.waiting import wait_for

# An arm that is driven may not be late, as it is where other tests start their processes on the same two cores.
drives = pytest.mark.realtime


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def alive(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status")
    return status.exists() and "\nState:\tZ" not in status.read_text()


@pytest.mark.slow
@drives
def test_goals_are_reached_and_held_for_three_seconds_and_the_path_is_drawn(start, policy_path, tmp_path):
    picture = tmp_path / "path.png"
    process = start.command("ros.demo", f"policy_path={policy_path}", f"output={picture}", "goals=2")
    assert process.wait(150) == 0, process.output
    assert "2 of 2 goals reached, and held for 3 s" in process.output
    image = imageio.imread(picture)
    assert image.shape[0] > 400
    assert image.std() > 10


@pytest.mark.slow
@drives
def test_a_policy_that_commands_positions_drives_an_arm_that_takes_them(start, position_run, tmp_path):
    picture = tmp_path / "path.png"
    overrides = (f"policy_path={position_run / 'policy.pt'}", f"output={picture}", "goals=2", "hold=1")
    process = start.command("ros.demo", *overrides)
    assert process.wait(120) == 0, process.output
    assert "2 of 2 goals reached, and held for 1 s" in process.output
    assert picture.is_file()


@pytest.mark.slow
@drives
def test_an_arm_with_seven_joints_is_driven_to_points_in_space(start, panda_run, tmp_path):
    picture = tmp_path / "path.png"
    overrides = (f"policy_path={panda_run / 'policy.pt'}", f"output={picture}", "goals=2", "hold=1")
    process = start.command("ros.demo", *overrides)
    assert process.wait(120) == 0, process.output
    assert "drives a virtual panda" in process.output
    assert "2 of 2 goals reached, and held for 1 s" in process.output
    assert picture.is_file()


@pytest.mark.slow
@pytest.mark.realtime  # it looks for others for a second
def test_it_refuses_to_start_where_a_robot_is_already(start, policy_path):
    start("virtual_robot").says("takes joint_velocity")
    process = start.run([sys.executable, "-m", "physai.ros.demo", f"policy_path={policy_path}"])
    assert process.wait(60) == 2
    assert process.lines[-1].startswith("error: another node uses /joint")
    assert "ROS_DOMAIN_ID" in process.lines[-1]


@pytest.mark.slow
@drives
def test_it_ends_with_the_reason_where_the_arm_is_stopped_for_good(start, domain, policy_path, tmp_path):
    process = start.command("ros.demo", f"policy_path={policy_path}", f"output={tmp_path / 'path.png'}")
    process.says("sending goals", 120.0)
    with contextlib.closing(Peer(domain, listen_to_commands=False)) as peer:  # who leaves at once may not be heard
        peer.emergency_stop()
        assert process.wait() == 2
    assert process.lines[-1] == "error: the inference node has stopped the robot: estop: emergency stop"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_its_nodes_end_with_it_however_it_ends(start, policy_path, number, tmp_path):
    process: Process = start.command("ros.demo", f"policy_path={policy_path}", f"output={tmp_path / 'path.png'}")
    process.says("sending goals", 120.0)
    nodes = children(process.pid)
    assert len(nodes) == 2
    os.kill(process.pid, number)
    process.wait()
    wait_for(lambda: not any(map(alive, nodes)), 10, "the nodes' end")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("policy_path=/nowhere/policy.pt", "error: /nowhere/policy.pt: no such file"),
        ("goals=0", "error: goals: "),
        ("max_velocity=9", "error: max_velocity: the robot's limit is 2.5 rad/s"),
        ("randomization=stong", "error: randomization/stong: no such config; did you mean 'strong'?"),
        ("gaols=3", "error: unknown key 'gaols'; did you mean 'goals'?"),
    ],
)
def test_bad_input_is_refused_in_one_line(run, policy_path, override, line):
    path = [] if override.startswith("policy_path") else [f"policy_path={policy_path}"]
    code, _, error = run("ros.demo", *path, override)
    assert code == 2
    assert error.splitlines()[-1].startswith(line)
