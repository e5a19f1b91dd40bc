"""Searches as a user runs them, with real trials."""

import csv
import json
import os
import signal
import sys

import pytest
from hydra.core.global_hydra import GlobalHydra
from optuna.pruners import ThresholdPruner

from physai.search import __main__ as search
from physai.search.space import make_space
from physai.search.study import Study
from physai.search.trials import time_to_target
from tests.training.small import TINY, command
from tests.waiting import wait_while_runs

OVERRIDES = (*TINY, "collector=single", "algo.epochs=1", "~search@search.ranges", "hydra.run.dir=search")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # a busy machine is no fault of a test


@pytest.fixture
def run(tmp_path, monkeypatch, capfd):
    """Search in this process, in an empty folder; return exit code, standard output and error."""

    def run(*arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["physai.search", *OVERRIDES, *arguments])
        monkeypatch.setenv("COLUMNS", "200")
        GlobalHydra.instance().clear()
        try:
            search.main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        return code, *capfd.readouterr()

    return run


def table(folder):
    with open(folder / "study.csv", newline="") as file:
        return list(csv.DictReader(file))


def summaries(folder):
    return {path.parent.name: path.read_bytes() for path in folder.glob("*/summary.json")}


def test_a_search_with_two_trials_at_a_time_survives_one_that_fails_and_can_be_made_longer(run, tmp_path):
    # a rate of 5e38 passes every check and explodes at the first update
    arguments = ("algo.optimizer.lr=choice(1e-3,5e38)", "seed=4", "search.jobs=2")
    code, output, error = run(*arguments, "search.trials=3")
    assert code == 0, output + error
    folder = tmp_path / "search"
    trials = table(folder)
    assert [trial["run"] for trial in trials] == ["0", "1", "2"]
    assert {trial["state"] for trial in trials} == {"complete", "fail"}
    finished = summaries(folder)
    for trial in trials:
        number, rate = trial["run"], trial["algo.optimizer.lr"]
        assert (trial["state"] == "complete") == (float(rate) == 1e-3)
        if trial["state"] == "complete":
            assert float(trial["success rate"]) == json.loads(finished[number])["success_rate"]
            assert f"[{number}] success rate" in output
        else:
            assert f"[{number}] failed: iteration 1: the loss is not finite" in output
        assert "Evaluating" in (folder / number / "output.txt").read_text() or trial["state"] == "fail"
        assert not (folder / number / "policy.pt").exists()
    assert "Evaluating" not in output  # trials print to files of their own
    assert "search: the best of 3 trials" in output
    assert output.rstrip().endswith("algo.optimizer.lr=0.001")
    assert (folder / "study.png").read_bytes().startswith(b"\x89PNG")
    code, output, error = run(*arguments, "search.trials=4")
    assert (code, len(table(folder))) == (0, 4), output + error
    assert "3 trials are done, 1 are left" in output
    assert {number: summaries(folder)[number] for number in finished} == finished
    code, _, error = run("algo.optimizer.lr=choice(1e-3,2e-3)", "seed=4")
    assert (code, error) == (2, "error: search holds a study of something else: choose another hydra.run.dir\n")


def test_the_time_to_a_target_is_made_small(run, tmp_path):
    arguments = ("algo.optimizer.lr=interval(1e-3,1e-2)", "search.objective=time_to_target", "search.target=0.01")
    code, output, error = run(*arguments, "search.trials=2", "search.jobs=2", "env.task.tolerance=0.4")
    assert code == 0, output + error
    for trial in table(tmp_path / "search"):
        assert trial["state"] == "complete"
        assert float(trial["seconds to target"]) == time_to_target(tmp_path / "search" / trial["run"], 0.01)


def test_a_trial_that_looks_worse_is_stopped_and_has_saved_itself(run, tmp_path, monkeypatch):
    monkeypatch.setattr("physai.search.study.MedianPruner", lambda: ThresholdPruner(lower=1.1))  # all do
    code, output, error = run("algo.optimizer.lr=interval(1e-3,1e-2)", "search.trials=1", "total_frames=100_000_000")
    assert (code, error) == (1, "error: none of 1 trials came to an end; the output.txt of each says why\n"), output
    assert "[0] pruned  (" in output
    assert "everything is saved" in (tmp_path / "search" / "0" / "output.txt").read_text()


def test_a_killed_search_goes_on_redoes_nothing_and_tries_what_it_would_have_tried(run, tmp_path):
    ranges = {"algo.optimizer.lr": "interval(1e-3,1e-2)"}
    arguments = (*(f"{key}={text}" for key, text in ranges.items()), "search.trials=4", "search.jobs=2")
    folder = tmp_path / "search"
    process = command("search", *OVERRIDES, *arguments, cwd=tmp_path)
    wait_while_runs(process, lambda: summaries(folder) and len(list(folder.glob("[123]/metrics.csv"))))
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = summaries(folder)
    code, output, error = run(*arguments)
    assert code == 0, output + error
    after = summaries(folder)
    assert sorted(after) == ["0", "1", "2", "3"]
    assert {name: after[name] for name in before} == before
    (tmp_path / "other").mkdir()
    study = Study(tmp_path / "other", {}, make_space(ranges), seed=0, minimize=False)
    expected = [study.ask()[1].params["algo.optimizer.lr"] for _ in range(4)]
    study.close()
    assert [float(trial["algo.optimizer.lr"]) for trial in table(folder)] == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-m", "seed=0,1"], "a search takes ranges as they are, without -m"),
        ([], "there is nothing to search: give a range"),
        (["algo.epochs=interval(3,1)"], "algo.epochs=interval(3,1): `low <= high` must hold"),
        (["algo.epochs=choice(1,-1)"], "algo.epochs: input should be greater than 0, got -1"),
        (["algo.epoch=choice(1,2)"], "unknown key 'algo.epoch'; did you mean 'algo.epochs'?"),
        (["search.objective=return", "seed=0,1"], "search.objective: input should be 'success_rate'"),
        (["search.target=2", "seed=0,1"], "search.target: input should be less than or equal to 1"),
        (["search.trial=2", "seed=0,1"], "unknown key 'search.trial'; did you mean 'search.trials'?"),
    ],
)
def test_a_bad_search_is_refused_in_one_line_before_anything_exists(run, tmp_path, arguments, message):
    code, _, error = run(*arguments)
    assert code == 2
    assert message in error
    assert len(error.strip().splitlines()) == 1, error
    assert list(tmp_path.iterdir()) == []
