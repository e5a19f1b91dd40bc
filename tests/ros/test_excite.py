"""Motions for an identification on real ROS 2: what is recorded, and how they end."""

import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from physai.identify.recording import read
from physai.identify.trials import cut
from physai.robots import RobotSpec
from tests.ros.peer import TOPIC

# An arm that is driven may not be late, as it is where other tests start their processes on the same two cores.
drives = pytest.mark.realtime
JOINTS = ("joint1", "joint2")
SECONDS = 10.0  # of motions: two or three, each after its rest, which is the least that can be cut into trials


@pytest.fixture
def excite(start, start_robot, policy_path, tmp_path):
    """Start a virtual robot, and what excites it; it records to ``tmp_path / "recording"``."""
    start_robot()

    def excite(**parameters):
        given = {"policy_path": policy_path, "output": tmp_path / "recording", "seconds": SECONDS, **parameters}
        return start("excite", **given)

    return excite


@pytest.fixture(scope="module")
def robot(reacher):
    return RobotSpec.from_config(reacher.robot)


def recorded(folder: Path):
    # The virtual robot tells of itself 100 times a second.
    return read(folder, JOINTS, 0.01, TOPIC)


@pytest.mark.slow
@drives
def test_motions_are_recorded_within_bounds_and_end_at_home_at_rest(excite, peer, robot, tmp_path):
    process = excite()
    assert process.wait(60) == 0, process.output
    data = recorded(tmp_path / "recording")
    trials = cut(data, "it", robot)
    said = re.search(r"(\d+) of (\d+) motions, (\d+) broken off", process.output)
    assert said, process.output
    begun, count, broken_off = map(int, said.groups())
    assert begun == count >= 2
    # A stall of the computer may break off one, or spoil it.
    assert broken_off <= 1
    assert len(trials) >= count - 1
    assert np.nanmax(np.abs(data.command)) <= 0.3
    assert not data.command[-1].any()
    assert np.abs(data.position[np.isfinite(data.position).all(axis=1)][-1]).max() < 0.03
    assert f"motion {count} of {count}: " in process.output
    line = process.lines[process.lines.index(process.says("next:")) + 1]
    assert line.split() == [
        *["python", "-m", "physai.identify"],
        f"data={tmp_path / 'recording'}",
        "env=reacher",
        "env.control_dt=0.01",
    ]
    assert not any(peer.commands[-1][1])


@pytest.mark.slow
@drives
def test_ctrl_c_stops_the_arm_at_once_and_leaves_a_complete_recording(excite, peer, tmp_path):
    process = excite()
    process.says("motion 1 of", 60.0)
    peer.moved(after=time.monotonic())
    pressed = time.monotonic()
    process.signal(signal.SIGINT)
    assert peer.first_zeros(pressed) < 0.2
    assert process.wait() == 130
    assert not any(peer.commands[-1][1])
    data = recorded(tmp_path / "recording")  # which refuses a recording without an end
    known = data.command[np.isfinite(data.command).all(axis=1)]
    assert known.any()
    assert not known[-1].any()


@pytest.mark.slow
@drives
@pytest.mark.parametrize("cause", ["emergency stop", "silence"])
def test_a_stop_for_good_ends_it_with_the_reason_and_zeros(excite, peer, tmp_path, cause):
    process = excite()
    process.says("motion 1 of", 60.0)
    peer.moved(after=time.monotonic())
    if cause == "emergency stop":
        peer.emergency_stop()
    else:  # longer than resume_timeout, 1 s: the controller forgets its goal
        peer.set_parameters("/virtual_robot", fault_stop=True)
        time.sleep(1.5)
        peer.set_parameters("/virtual_robot", fault_stop=False)
    assert process.wait() == 1
    said = {"emergency stop": "estop: emergency stop", "silence": "the robot was silent for"}[cause]
    assert any("FATAL" in line and said in line for line in process.lines), process.output
    assert not any(peer.commands[-1][1])
    assert not recorded(tmp_path / "recording").command[-1].any()


@pytest.mark.slow
@drives
def test_a_moment_of_silence_breaks_off_a_motion_and_the_others_follow(excite, peer, robot, tmp_path):
    process = excite()
    process.says("motion 1 of", 60.0)
    peer.moved(after=time.monotonic())
    peer.set_parameters("/virtual_robot", fault_stop=True)
    peer.first_zeros(time.monotonic())
    peer.set_parameters("/virtual_robot", fault_stop=False)
    assert process.wait(60) == 0, process.output
    assert re.search(r"[12] broken off", process.output), process.output  # one more by a stall of the computer
    assert len(cut(recorded(tmp_path / "recording"), "it", robot)) >= 1


@pytest.mark.slow
def test_an_emergency_stop_of_before_ends_it_before_anything_is_recorded(start, policy_path, peer, tmp_path):
    node = start("inference_node", policy_path=policy_path)
    peer.wait_state("waiting")
    peer.emergency_stop()
    peer.wait_state("estop")
    node.signal(signal.SIGTERM)
    node.wait()
    process = start("excite", policy_path=policy_path, output=tmp_path / "recording")
    assert process.wait() == 1
    assert "stopped until ~/reset" in process.output
    assert not (tmp_path / "recording").exists()


@pytest.mark.slow
def test_the_recorder_counts_as_no_controller(start, policy_path, tmp_path):
    process = start("excite", policy_path=policy_path, output=tmp_path / "recording")
    process.says("waiting: no joint state yet; no controller listens to /joint_velocity_controller/commands", 60.0)
    process.signal(signal.SIGINT)
    assert process.wait() == 130


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"policy_path": "/nowhere/policy.pt"}, "error: /nowhere/policy.pt: no such file"),
        ({"max_velocity": 9.0}, "error: max_velocity: 9.0 rad/s is beyond the robot's limit, 2.5 rad/s"),
        ({"seconds": -1.0}, "error: seconds: must lie between 1 and 3600 s"),
        ({"output": "/proc/nowhere/recording"}, "error: output: /proc/nowhere"),
        ({"output": "."}, "error: output: . exists already"),
        ({"goal": "[0.1, 0.4]"}, "error: goal: goal rejected: its number"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_bad_input_is_refused_in_one_line(start, policy_path, tmp_path, parameters, line):
    output = tmp_path / "recording"
    process = start("excite", **{"policy_path": policy_path, "output": output, **parameters})
    assert process.wait() == 2
    errors = [each for each in process.lines if each.startswith("error: ")]
    assert len(errors) == 1, process.output
    assert errors[0].startswith(line)
    assert not output.exists()


@pytest.mark.slow
def test_a_robot_that_takes_positions_is_refused(start, position_run, tmp_path):
    process = start("excite", policy_path=position_run / "policy.pt", output=tmp_path / "recording")
    assert process.wait() == 2
    assert "error: policy_path: its robot takes joint_position; motions are joint_velocity" in process.lines
