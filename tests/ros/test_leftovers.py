"""A session of tests that fails leaves no process and no shared memory behind."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ros.peer import SHM, mapped_segments

SESSION = """
import json
import os
import signal
from pathlib import Path

from tests.ros.loop import closed_loop
from tests.ros.peer import mapped_segments, node_command


def test_fails_with_nodes_that_run(start, peer):
    policy = os.environ["POLICY"]
    inference_node = node_command("inference_node", policy_path=policy, autostart=True, goal=[-0.3, -0.2])
    recorder = node_command("record", output=Path(os.environ["REPORT"]).with_name("bag"))
    nodes = [start.run(command) for command in (node_command("virtual_robot"), inference_node, recorder)]
    with closed_loop(policy, goal=[-0.3, -0.2]) as loop:
        peer.moved()
        loop.peer.moved()
        nodes.append(loop.node)
        found = set().union(*(mapped_segments(str(pid)) for pid in [os.getpid(), *(node.pid for node in nodes)]))
        report = {"pids": [os.getpid(), loop.node._forge.pid] + [node.pid for node in nodes]}
        Path(os.environ["REPORT"]).write_text(json.dumps(report | {"segments": sorted(map(str, found))}))
        nodes[1].signal(signal.SIGKILL)
        nodes[0].signal(signal.SIGSTOP)  # the others run, one of them forged
        assert False, "on purpose"
"""


@pytest.mark.slow
def test_a_failing_session_leaves_nothing(policy_path, tmp_path):
    (tmp_path / "test_fails.py").write_text(SESSION)
    report = tmp_path / "report.json"
    environment = {**os.environ, "POLICY": str(policy_path), "REPORT": str(report)}
    environment = {key: value for key, value in environment.items() if not key.startswith("PYTEST")}
    command = [sys.executable, "-m", "pytest", "-p", "tests.ros.conftest", "-p", "no:cacheprovider", "-p", "no:xdist"]
    root = Path(__file__).parents[2]
    session = subprocess.run(
        [*command, "--rootdir", str(tmp_path), str(tmp_path / "test_fails.py")],
        cwd=root,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert "on purpose" in session.stdout, session.stdout + session.stderr
    assert session.returncode == 1
    left = json.loads(report.read_text())
    assert len(left["segments"]) >= 4
    alive = [pid for pid in left["pids"] if Path(f"/proc/{pid}").exists()]
    for pid in alive:
        os.kill(pid, signal.SIGKILL)
    assert alive == []
    # Ports are numbered: other sessions on this machine may use the same by now.
    names = [segment.name for segment in {Path(name) for name in left["segments"]} - mapped_segments()]
    assert [path.name for path in SHM.iterdir() if any(name in path.name for name in names)] == []
