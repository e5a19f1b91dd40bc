"""Sweeps whose jobs run in other processes, as a user runs them."""

import json
import os
import signal

import pytest

from tests.training.small import TINY, command
from tests.waiting import wait_for, wait_while_runs

SWEEP = ("-m", *TINY, "hydra.sweep.dir=sweep")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]  # a busy machine is no fault of a test


def run(*arguments, cwd):
    process = command("train", *SWEEP, *arguments, cwd=cwd)
    output = process.communicate()[0]
    return process.returncode, output


def finished(sweep):
    return {path.parent.name: path.read_bytes() for path in sweep.glob("*/summary.json")}


def assert_nothing_is_left_of(group, seconds=30):
    def gone():
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        return False

    wait_for(gone, seconds, f"the processes of group {group} to end")


def test_joblib_runs_three_seeds_in_two_processes(tmp_path):
    code, output = run("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=0,1,2", cwd=tmp_path)
    assert code == 0, output
    assert sorted(finished(tmp_path / "sweep")) == ["0", "1", "2"]
    assert [f"[{number}] " in output for number in range(3)] == [True] * 3
    assert output.index("[2] ") < output.index("differs by")
    assert "Evaluating the best" not in output  # who prints at the same time as others does so to a file of its own
    assert "Evaluating the best" in (tmp_path / "sweep" / "2" / "output.txt").read_text()
    assert (tmp_path / "sweep" / "training.png").is_file()
    hashes = {json.loads(summary)["weights_sha256"] for summary in finished(tmp_path / "sweep").values()}
    assert len(hashes) == 3


def test_submitit_s_local_executor_runs_a_sweep_and_a_job_that_fails_is_named(tmp_path):
    # a rate of 5e38 passes every check and explodes at the first update
    code, output = run("hydra/launcher=submitit_local", "algo.optimizer.lr=1e-3,5e38", cwd=tmp_path)
    assert code == 1, output
    assert sorted(finished(tmp_path / "sweep")) == ["0"]
    assert "error: sweep/1: iteration 1: the loss is not finite" in output
    assert "error: 1 of 2 runs failed" in output


def test_ray_runs_a_sweep(tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_worker_niceness", "0")  # it would wait for other tests
    code, output = run("hydra/launcher=ray", "seed=0,1", cwd=tmp_path)
    assert code == 0, output
    assert sorted(finished(tmp_path / "sweep")) == ["0", "1"]


def test_a_ray_in_each_job_of_ray_is_refused_before_anything_starts(tmp_path):
    code, output = run("hydra/launcher=ray", "collector=ray", "seed=0,1", cwd=tmp_path)
    assert (code, output.strip().splitlines()[-1][:24]) == (2, "error: hydra/launcher=ra"), output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("launcher", "number"),
    [
        (["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"], signal.SIGINT),
        (["hydra/launcher=submitit_local", "hydra.sweeper.max_batch_size=2"], signal.SIGTERM),
    ],
    ids=["joblib", "submitit"],
)
def test_a_signal_to_a_parallel_sweep_ends_its_jobs(tmp_path, launcher, number):
    process = start((*launcher, "seed=0,1", "total_frames=100_000_000"), tmp_path)
    wait_while_runs(process, lambda: len(list((tmp_path / "sweep").glob("*/metrics.csv"))) == 2)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does
    else:
        process.send_signal(number)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 128 + number, output
    assert_nothing_is_left_of(process.pid)


def start(arguments, cwd):
    """Start a sweep in a process group of its own."""
    return command("train", *SWEEP, *arguments, cwd=cwd)
