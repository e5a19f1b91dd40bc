"""What the nodes refuse at their start: one line that says why, exit code 2, and not a word to the robot."""

import shutil
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from physai.errors import UserError
from physai.ros.bridge.robot_link import RobotLink
from tests.ros.forge import forged
from tests.ros.loop import closed_loop
from tests.waiting import wait_for


@pytest.fixture
def files(policy_path, tmp_path):
    """Policy files that must not be taken."""
    content = policy_path.read_bytes()
    (tmp_path / "truncated.pt").write_bytes(content[: len(content) // 2])
    (tmp_path / "empty.pt").write_bytes(b"")
    (tmp_path / "text.pt").write_text("not a policy\n")
    (tmp_path / "folder.pt").mkdir()
    shutil.copy(policy_path, tmp_path / "beside.pt")
    (tmp_path / "beside.pt.sha256").write_text("0" * 64 + "  beside.pt\n")
    (tmp_path / "broken.yaml").write_text("inference_node: [1, 2\n")
    return tmp_path


@pytest.fixture
def refused(domain, peer):
    """Run nodes with bad parameters, two at once, and see that each is refused as expected."""

    def check(case):
        parameters, line = case
        module = parameters.pop("module", "inference_node")
        process = forged(module, domain, *parameters.pop("args", []), **parameters)
        try:
            code = process.wait(60)
        finally:
            process.end()
        errors = [text for text in process.lines if text.startswith("error: ")]
        if code != 2 or len(errors) != 1 or line not in errors[0] or "Traceback" in process.output:
            return f"{parameters}: wanted {line!r}, got exit code {code} and\n{process.output}"
        return None

    def refused(cases):
        with ThreadPoolExecutor(2) as pool:
            failures = [failure for failure in pool.map(check, cases) if failure]
        assert not failures, "\n\n".join(failures)
        assert peer.commands == []
        assert peer.states == []

    return refused


@pytest.mark.slow
def test_bad_policy_files_are_refused(files, refused, policy_path):
    refused(
        [
            ({}, "error: policy_path: required"),
            ({"policy_path": files / "none.pt"}, "none.pt: "),
            ({"policy_path": files / "truncated.pt"}, "truncated.pt: "),
            ({"policy_path": files / "empty.pt"}, "empty.pt: "),
            ({"policy_path": files / "text.pt"}, "text.pt: "),
            ({"policy_path": files / "folder.pt"}, "folder.pt: "),
            ({"policy_path": files / "beside.pt"}, "not that of beside.pt.sha256, 0000000000000000..."),
            ({"policy_path": policy_path, "policy_sha256": "'" + "1" * 64 + "'"}, "not the expected one, 1111111111"),
            ({"policy_path": policy_path, "policy_sha256": '""'}, "error: policy_sha256: is empty; 'any' takes every"),
            ({"policy_path": policy_path, "watchdog": "no name"}, "error: watchdog: must be the name of a node, got"),
            ({"policy_path": policy_path, "joints": "[a, b]"}, "joints: ['a', 'b'] must be distinct and hold all"),
            ({"policy_path": policy_path, "joints": "[joint1, joint1]"}, "joints: ['joint1', 'joint1'] must be dist"),
        ]
    )


@pytest.mark.slow
@pytest.mark.fault("`ROS_DOMAIN_ID` that is none, empty `policy_sha256`, `watchdog` that is no name")
def test_bad_parameters_are_refused(files, refused, policy_path):
    policy = {"policy_path": policy_path}
    refused(
        [
            (policy | {"max_velocity": "fast"}, "error: max_velocity: a float is needed, got 'fast'"),
            (policy | {"max_velocity": ".nan"}, "error: max_velocity: must lie between 0.001 and 100 rad/s, got nan"),
            (policy | {"state_timeout": -1}, "error: state_timeout: must lie between 0.001 and 10 s, got -1.0"),
            (
                policy | {"recovery_states": 2.5, "autostart": 1, "trigger": "never"},
                "recovery_states: a int is needed, got 2.5; trigger: must be 'timer' or 'joint_state', got 'never'",
            ),
            (policy | {"rate_hz": 20}, "error: rate_hz: must be at least that of the policy, 50, got 20.0"),
            (policy | {"goal": "[0.3, 0.2, 0.1]"}, "error: goal: goal rejected: it has the shape [3], not [2]"),
            (policy | {"goal": "[0.3, .nan]"}, "error: goal: "),
            (policy | {"goal": "[3, 0]"}, "error: goal: goal rejected: 3.000 m from the base"),
            (policy | {"max_velocity": 2.0}, "error: limit_margin: at 2.0 rad/s and a state_timeout of 0.1 s"),
            (policy | {"args": ["--params-file", str(files / "none.yaml")]}, "none.yaml"),
            (policy | {"args": ["--params-file", str(files / "broken.yaml")]}, "broken.yaml"),
            (policy | {"args": ["-p", "max_velocity"]}, "max_velocity"),
            (policy | {"goal": "[0, 0.4]"}, "Sequence should be of same type"),  # ROS' own rule
            ({"module": "virtual_robot", "env": "nobody"}, "nobody"),
            ({"module": "virtual_robot", "joints": "[joint1]"}, "joints: must be ['joint1', 'joint2'] in some order"),
            ({"module": "command_watchdog", "timeout": 0}, "error: timeout: must lie between 0.01 and 10 s, got 0.0"),
        ]
    )


@pytest.mark.slow
@pytest.mark.realtime
def test_whole_numbers_are_taken_for_floats_and_misspelt_names_warn_with_the_nearest(policy_path, tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text("inference_node:\n  ros__parameters:\n    max_velocty: 0.1\n    max_acceleration: 3\n    xyz: 1\n")
    arguments = ["--params-file", str(file)]
    with closed_loop(policy_path, *arguments, rate_hz=100, clock_jump=2, max_velocity=0.1, goal=[0.0, 0.4]) as loop:
        loop.node.says("unknown parameter 'max_velocty'; did you mean 'max_velocity'?")
        assert loop.node.says("unknown parameter 'xyz'").endswith("'xyz'")
        loop.node.says("at most 0.1 rad/s")
        loop.peer.moved(commands=100)

        def rate() -> float:
            times = [at for at, _ in loop.peer.commands][-100:]
            return 99 / (times[-1] - times[0])

        wait_for(lambda: 95 < rate() < 105, 10.0, "100 commands a second")  # when this process is not busy itself


@pytest.mark.slow
@pytest.mark.fault("`ROS_DOMAIN_ID` that is none, empty `policy_sha256`, `watchdog` that is no name")
def test_a_domain_that_there_is_not_is_refused_in_one_line(start, policy_path):
    commands = {"inference_node": [], "demo": [f"policy_path={policy_path}"]}
    processes = [
        start.run([sys.executable, "-m", f"physai.ros.{module}", *arguments], {"ROS_DOMAIN_ID": "999"})
        for module, arguments in commands.items()
    ]
    for process in processes:
        assert process.wait(60) == 2
        assert process.lines[-1] == "error: ROS_DOMAIN_ID: must be a whole number from 0 to 232, got '999'"
        assert "Traceback" not in process.output


@pytest.mark.parametrize("domain", ["999", "abc", "-1", "233", "7x"])
def test_an_environment_refuses_it_too(monkeypatch, domain):
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(UserError, match=f"ROS_DOMAIN_ID: must be a whole number from 0 to 232, got '{domain}'"):
        RobotLink(["joint1"], 0.1, None, [])
