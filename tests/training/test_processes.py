"""Training with robots in processes of their own: nothing hangs, nothing is left behind, and runs go on."""

import functools
import json
import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec

import pytest

from tests.training.processes import all_gone, command_of, descendants
from tests.training.small import SMALL, command, metrics

SIZES = (*SMALL, "collector.num_envs=64", "collector.frames_per_batch=1024", "env.task.max_steps=40")
needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
COLLECTORS = ("async", "multi_sync", "multi_async", pytest.param("ray", marks=needs_ray))
WORKERS = {"single": 0, "async": 1}  # others have two
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),  # two or three whole runs each
    pytest.mark.skipif(sys.platform != "linux", reason="workers are found in /proc"),
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Makes, once for each collector, a run that nothing has disturbed."""

    @functools.cache
    def run(collector):
        folder = tmp_path_factory.mktemp(collector)
        process = command("train", *SIZES, f"collector={collector}", "hydra.run.dir=run", cwd=folder)
        output = process.communicate()[0]
        assert process.returncode == 0, output
        return folder / "run"

    return lambda collector: run("multi_sync" if collector == "ray" else collector)  # whose runs are the same


def start(collector, folder, *overrides):
    """Start a run, wait until it has learnt from its first batch, and return it, its workers and all its processes."""
    process = subprocess.Popen(
        [sys.executable, "-m", "physai.train", *SIZES, f"collector={collector}", *overrides, "hydra.run.dir=run"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # a process group, as a terminal makes
    )
    deadline = time.monotonic() + 120
    while not (folder / "run" / "metrics.csv").is_file() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    everybody = descendants(process.pid)
    workers = {one for one in everybody if collector != "ray" or "WorkerCollector" in command_of(one)}
    assert len(workers) == WORKERS.get(collector, 2)
    return process, workers, everybody


def assert_goes_on(folder, finished):
    """Resume a run: it ends as the one that nothing has disturbed, to the last bit."""
    process = command("train", "resume=run", cwd=folder)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    ours, theirs = (json.loads((run / "summary.json").read_text()) for run in (folder / "run", finished))
    assert ours["frames"] == theirs["frames"]
    assert metrics(folder / "run") == metrics(finished)
    assert ours["weights_sha256"] == theirs["weights_sha256"]


@pytest.mark.parametrize("collector", ["single", *COLLECTORS[1:]])  # async: tests/training/test_loop.py
def test_a_killed_run_leaves_no_process_and_goes_on(finished, tmp_path, collector):
    process, _, everybody = start(collector, tmp_path)
    process.kill()
    process.communicate()
    assert all_gone(everybody)
    assert_goes_on(tmp_path, finished(collector))


@pytest.mark.parametrize("collector", COLLECTORS)
def test_a_killed_worker_ends_the_run_in_one_line_and_it_goes_on(finished, tmp_path, collector):
    process, workers, everybody = start(collector, tmp_path)
    os.kill(min(workers), signal.SIGKILL)
    killed = time.monotonic()
    output = process.communicate(timeout=60)[0]
    assert time.monotonic() - killed < 30
    assert process.returncode == 2, output
    assert "Traceback" not in output
    assert output.count("error: a process that collects has ended (") == 1
    assert all_gone(everybody)
    assert_goes_on(tmp_path, finished(collector))


@pytest.mark.parametrize(
    ("collector", "number", "code"),
    [
        ("async", signal.SIGINT, 130),
        ("multi_sync", signal.SIGINT, 130),
        ("multi_async", signal.SIGINT, 130),
        pytest.param("ray", signal.SIGTERM, 143, marks=needs_ray),
    ],
)
def test_a_signal_that_reaches_all_processes_saves_and_the_run_goes_on(finished, tmp_path, collector, number, code):
    process, _, everybody = start(collector, tmp_path, "checkpoint.every_frames=1000000")
    os.killpg(process.pid, number)
    output = process.communicate()[0]
    assert process.returncode == code, output
    assert "python -m physai.train resume=run" in output
    assert all_gone(everybody)
    assert_goes_on(tmp_path, finished(collector))


@pytest.mark.parametrize(
    ("late", "number", "code"), [(0.0, signal.SIGINT, 130), (0.1, signal.SIGTERM, 143), (0.4, signal.SIGINT, 130)]
)
def test_a_signal_while_the_processes_start_ends_them_all(tmp_path, late, number, code):
    process = command("train", *SIZES, "hydra.run.dir=run", cwd=tmp_path, start_new_session=True)
    deadline = time.monotonic() + 60
    while not (everybody := descendants(process.pid)) and time.monotonic() < deadline:
        time.sleep(0.001)
    time.sleep(late)
    os.killpg(process.pid, number)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == code, output
    assert "Traceback" not in output
    assert all_gone(everybody)
