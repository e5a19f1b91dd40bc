"""Training with robots in processes of their own: as reproducible as with one, and nothing is left behind."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.training.small import SMALL, command, metrics

OVERRIDES = (*SMALL, "collector=multi_sync", "collector.num_envs=16", "collector.frames_per_batch=1024")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("processes")
    process = command("train", *OVERRIDES, "hydra.run.dir=run", cwd=folder)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    return folder / "run", json.loads((folder / "run" / "summary.json").read_text())


def children(pid):
    listed = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    tracker = b"resource_tracker"  # Python's own, for shared memory
    return [child for child in listed if tracker not in Path(f"/proc/{child}/cmdline").read_bytes()]


def started(tmp_path):
    """A run that has learnt from its first batch, and its workers."""
    process = command("train", *OVERRIDES, "hydra.run.dir=run", cwd=tmp_path)
    deadline = time.monotonic() + 60
    while not (tmp_path / "run" / "metrics.csv").is_file() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    workers = children(process.pid)
    assert len(workers) == 2
    return process, workers


def all_gone(pids):
    deadline = time.monotonic() + 10
    while any(Path(f"/proc/{pid}").exists() for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not any(Path(f"/proc/{pid}").exists() for pid in pids)


def resume(tmp_path):
    process = command("train", "resume=run", cwd=tmp_path)
    output = process.communicate()[0]
    assert process.returncode == 0, output


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="workers are found in /proc"),
]


def test_a_killed_run_leaves_no_worker_and_goes_on_bit_for_bit(finished, tmp_path):
    run, summary = finished
    process, workers = started(tmp_path)
    process.kill()
    process.communicate()
    assert all_gone(workers)
    resume(tmp_path)
    assert metrics(tmp_path / "run") == metrics(run)
    assert summary["weights_sha256"] in (tmp_path / "run" / "summary.json").read_text()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_that_reaches_all_processes_saves_and_the_run_goes_on(finished, tmp_path, number, code):
    process = subprocess.Popen(
        [sys.executable, "-m", "physai.train", *OVERRIDES, "checkpoint.every_frames=1000000", "hydra.run.dir=run"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # a process group, as a terminal makes
    )
    deadline = time.monotonic() + 60
    while not (tmp_path / "run" / "metrics.csv").is_file() and time.monotonic() < deadline:
        time.sleep(0.005)
    os.killpg(process.pid, number)
    output = process.communicate()[0]
    assert process.returncode == code, output
    assert "python -m physai.train resume=run" in output
    resume(tmp_path)
    assert finished[1]["weights_sha256"] in (tmp_path / "run" / "summary.json").read_text()


def test_a_killed_worker_ends_the_run_in_one_line_and_it_can_be_resumed(finished, tmp_path):
    process, workers = started(tmp_path)
    os.kill(workers[0], signal.SIGKILL)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 2
    assert "Traceback" not in output
    assert "error: a process that collects has ended (exit code -9)" in output
    assert all_gone(workers)
    resume(tmp_path)
    assert finished[1]["weights_sha256"] in (tmp_path / "run" / "summary.json").read_text()
