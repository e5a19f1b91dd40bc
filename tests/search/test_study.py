"""What a study keeps, and that an interrupted search asks what another would have asked."""

import contextlib
import math
import os

import pytest

from physai.errors import UserError
from physai.search.report import Report
from physai.search.space import make_space
from physai.search.study import Study

ABOUT = {"fixed": ["threads=1"], "ranges": {"x": "interval(0,1)"}}
SPACE = make_space({"x": "interval(0,1)", "n": "range(0,9)", "kind": "choice(a,b)"})


@contextlib.contextmanager
def opened(folder, about=ABOUT, space=SPACE, minimize=False):
    study = Study(folder, about, space, seed=3, minimize=minimize)
    try:
        yield study
    finally:
        study.close()


def value(params):
    return params["x"] + params["n"] / 10 + (params["kind"] == "b")


def asked(folder, trials=14, kills=()):
    """Search with one trial at a time, which is killed while the given runs take place; return what each tried."""
    tried = {}
    kills = list(kills)
    while len(tried) < trials:
        with opened(folder) as study:
            while len(tried) < trials:
                run, trial = study.ask()
                if run in kills:
                    kills.remove(run)
                    break
                tried[run] = trial.params
                study.tell(trial, value(trial.params))
    return tried


def test_an_interrupted_search_tries_what_an_uninterrupted_one_does(tmp_path):
    (tmp_path / "whole").mkdir()
    (tmp_path / "killed").mkdir()
    whole = asked(tmp_path / "whole")
    assert len({str(params) for params in whole.values()}) == 14
    assert asked(tmp_path / "killed", kills=[0, 3, 3, 12]) == whole  # the last after the first ten, which are random


def test_values_that_were_not_all_drawn_when_the_search_was_killed_are_drawn_again(tmp_path):
    (tmp_path / "whole").mkdir()
    whole = asked(tmp_path / "whole", trials=1)
    (tmp_path / "killed").mkdir()
    with opened(tmp_path / "killed") as study:
        study._study.ask({"x": SPACE["x"]})
    assert asked(tmp_path / "killed", trials=1) == whole


def test_values_that_were_not_all_taken_again_when_the_search_was_killed_are_taken_again(tmp_path):
    with opened(tmp_path) as study:
        params = study.ask()[1].params
    with opened(tmp_path) as study:
        study._study.ask({"x": SPACE["x"]})  # killed before it had taken the others
    with opened(tmp_path) as study:
        run, trial = study.ask()
        assert (run, trial.params) == (0, params)
        assert study.ask()[0] == 1


def test_trials_that_were_interrupted_are_tried_again_and_those_that_ended_are_not(tmp_path):
    with opened(tmp_path) as study:
        trials = [study.ask()[1] for _ in range(4)]
        study.tell(trials[0], 0.5)
        study.tell(trials[1], error="the loss is not finite")
        study.tell(trials[2])
        trials[3].report(0.25, 2)
    with opened(tmp_path) as study:
        assert study.done() == 3
        assert study.trials()[3].last_step == 2
        run, again = study.ask()
        assert (run, again.params) == (3, trials[3].params)
        assert study.ask()[0] == 4
        assert [trial.state.name for trial in study.trials().values()] == [
            "COMPLETE", "FAIL", "PRUNED", "RUNNING", "RUNNING",
        ]  # fmt: skip


@pytest.mark.parametrize(
    "other",
    [
        {"about": ABOUT | {"fixed": ["threads=2"]}},
        {"space": make_space({"x": "interval(0,1)", "n": "range(0,8)", "kind": "choice(a,b)"})},
        {"space": make_space({"x": "interval(0,1)"})},
    ],
)
def test_a_study_of_something_else_is_refused_and_stays_as_it_is(tmp_path, other):
    with opened(tmp_path) as study:
        study.ask()
    before = (tmp_path / "study.log").read_bytes()
    refused = pytest.raises(UserError, match=r"holds a study of something else: choose another hydra\.run\.dir")
    with refused, opened(tmp_path, **other):
        pass
    assert (tmp_path / "study.log").read_bytes() == before


@pytest.mark.parametrize("content", ["no study\n" * 9, "", '{"op_code": 0}\n', "\x00\x01"])
def test_a_damaged_study_is_named_in_one_line_and_stays_as_it_is(tmp_path, content):
    (tmp_path / "study.log").write_text(content)
    with pytest.raises(UserError, match=r"study\.log: no study can be read there") as error, opened(tmp_path):
        pass
    assert len(str(error.value).splitlines()) == 1
    assert (tmp_path / "study.log").read_text() == content


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "0").mkdir()
    with pytest.raises(UserError, match="holds no study, but 0: choose another"), opened(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["0"]


def test_two_searches_do_not_work_on_one_study(tmp_path):
    with opened(tmp_path), pytest.raises(UserError, match="another search is at work there"), opened(tmp_path):
        pass


def test_a_last_line_that_was_not_written_to_its_end_and_a_lock_that_was_left_are_no_harm(tmp_path):
    with opened(tmp_path) as study:
        study.tell(study.ask()[1], 0.5)
    with open(tmp_path / "study.log", "a") as file:
        file.write('{"op_code":4,"worke')
    os.symlink("study.log", tmp_path / "study.log.lock")
    with opened(tmp_path) as study:
        assert study.ask()[0] == 1
    with opened(tmp_path) as study:
        assert study.done() == 1


@pytest.mark.parametrize("evil", [{"run": "../.."}, {"run": 7}, {"run": True}, {"run": -1}])
def test_a_study_from_elsewhere_names_no_folder(tmp_path, evil):
    with opened(tmp_path) as study:
        study._study.enqueue_trial({}, user_attrs=evil)
    with pytest.raises(UserError, match="holds a study of something else"), opened(tmp_path):
        pass


def test_a_study_from_elsewhere_names_no_key(tmp_path):
    with opened(tmp_path) as study:
        study._study.enqueue_trial({"env.task._target_": "evil.Thing"})
    with pytest.raises(UserError, match="holds a study of something else"), opened(tmp_path):
        pass


def test_trials_without_a_value_are_in_the_report_and_do_not_win(tmp_path, capsys):
    with opened(tmp_path, minimize=True) as study:
        for seconds in (3.0, math.inf, 2.0, 4.0):
            study.tell(study.ask()[1], seconds)
        study.tell(study.ask()[1], error="the loss is not finite")
        pruned = study.ask()[1]
        pruned.report(-0.9, 1)
        study.tell(pruned)
        report = Report(tmp_path, study)
        report.ended(4)
        report.summary(["threads=1"])
        best = study.trials()[2].params
    output = capsys.readouterr().out
    assert "[4] failed: the loss is not finite  (" in output
    assert f"python -m physai.train threads=1 x={best['x']} n={best['n']} kind={best['kind']}" in output
    rows = [row.split(",") for row in (tmp_path / "study.csv").read_text().splitlines()]
    assert rows[0] == ["run", "state", "seconds to target", "x", "n", "kind"]
    assert [row[1] for row in rows[1:]] == ["complete"] * 4 + ["fail", "pruned"]
    assert [row[2] for row in rows[1:]] == ["3.0", "inf", "2.0", "4.0", "", ""]
    assert (tmp_path / "study.png").read_bytes().startswith(b"\x89PNG")


def test_a_search_whose_trials_all_fail_ends_in_one_line_and_exit_code_1(tmp_path, capsys):
    with opened(tmp_path) as study:
        study.tell(study.ask()[1], error="the loss is not finite")
        with pytest.raises(SystemExit) as stop:
            Report(tmp_path, study).summary([])
    assert stop.value.code == 1
    assert capsys.readouterr().err == "error: none of 1 trials came to an end; the output.txt of each says why\n"
