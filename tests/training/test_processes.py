"""Training with robots in processes of their own: nothing hangs, nothing is left behind, and runs go on."""

import os
import signal
import sys
import time
from importlib.util import find_spec

import pytest

from tests.training.processes import all_gone, command_of, descendants
from tests.training.small import SIZES, assert_same_run, command, metrics, resume_here, undisturbed
from tests.waiting import wait_while_runs

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
COLLECTORS = ("async", "multi_sync", "multi_async", pytest.param("ray", marks=needs_ray))
WORKERS = {"async": 1}  # others have two
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),  # four starts each
    pytest.mark.skipif(sys.platform != "linux", reason="workers are found in /proc"),
]


class Run:
    """A run in ``folder / "run"``, which can be started again and again.

    Attributes:
        process: The command.
        workers: Processes that step robots.
        everybody: All of its processes.
    """

    def __init__(self, folder, collector):
        self.folder, self.path, self.collector = folder, folder / "run", collector

    def start(self):
        """Start it or go on with it, and wait until it has learnt from its first batch."""
        log, begin = self.path / "metrics.csv", [*SIZES, f"collector={self.collector}", "hydra.run.dir=run"]
        before = log.read_bytes() if log.is_file() else b""
        saved = max((int(path.stem) for path in self.path.glob("checkpoints/0*.pt")), default=0)
        arguments = ["resume=run"] if self.path.is_dir() else begin
        # A process group, as a terminal makes.
        self.process = command("train", *arguments, cwd=self.folder)
        wait_while_runs(self.process, lambda: self._has_learnt(log, before, saved), 120)
        assert self.process.poll() is None, self.process.communicate()[0]
        self.everybody = descendants(self.process.pid)
        is_ray = self.collector == "ray"
        self.workers = {one for one in self.everybody if not is_ray or "WorkerCollector" in command_of(one)}
        assert len(self.workers) == WORKERS.get(self.collector, 2)

    def _has_learnt(self, log, before, saved):
        if not log.is_file() or log.read_bytes() == before:
            return False
        rows = metrics(self.path)
        return bool(rows) and int(rows[-1]["frames"] or 0) > saved

    def ends(self, code):
        """Wait for the end of all of its processes; return what it printed."""
        output = self.process.communicate(timeout=60)[0]
        assert self.process.returncode == code, output
        assert all_gone(self.everybody)
        return output


@pytest.mark.parametrize("collector", COLLECTORS)
def test_a_run_goes_on_from_a_killed_worker_a_signal_to_all_processes_and_a_kill(once, tmp_path, collector):
    """Each ends all of its processes; then the run ends as one that nothing has disturbed, to the last bit.

    Where only the way of collecting differs from multi_sync, a killed worker is enough: of each other end there is a
    test for the collector alone, or for the default one in tests/training/test_trainer. That a run of Ray goes on is
    seen where it loses a computer, for to start Ray once more takes ten seconds.
    """
    run = Run(tmp_path, collector)

    if collector != "ray":  # where Ray loses a worker, and a computer with one: tests/collectors
        run.start()
        os.kill(min(run.workers), signal.SIGKILL)
        killed = time.monotonic()
        output = run.ends(2)
        assert time.monotonic() - killed < 30
        assert "Traceback" not in output
        assert output.count("error: a process that collects has ended (") == 1

    if collector in ("multi_sync", "ray"):
        run.start()
        assert any("raylet" in command_of(one) for one in run.everybody) == (collector == "ray")
        number = signal.SIGTERM if collector == "ray" else signal.SIGINT
        os.killpg(run.process.pid, number)
        assert "python -m physai.train resume=run" in run.ends(128 + number)
        checkpoints = sorted((run.path / "checkpoints").glob("0*.pt"))
        assert int(checkpoints[-1].stem) == int(metrics(run.path)[-1]["frames"])

        run.start()
        run.process.kill()
        run.ends(-signal.SIGKILL)

    if collector != "ray":
        resume_here(run.path)
        assert_same_run(run.path, undisturbed(once, collector))


@pytest.mark.parametrize(
    ("late", "number", "code"), [(0.0, signal.SIGINT, 130), (0.1, signal.SIGTERM, 143), (0.4, signal.SIGINT, 130)]
)
def test_a_signal_while_the_processes_start_ends_them_all(tmp_path, late, number, code):
    process = command("train", *SIZES, "hydra.run.dir=run", cwd=tmp_path, finalize=True)
    deadline = time.monotonic() + 60
    while not (everybody := descendants(process.pid)) and time.monotonic() < deadline:
        time.sleep(0.001)
    time.sleep(late)
    os.killpg(process.pid, number)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == code, output
    assert "Traceback" not in output
    assert all_gone(everybody)
