"""A search with Optuna: what it looks for and through, and how it goes on after a kill."""

import json
import math
import pickle

import optuna
import pytest
from omegaconf import OmegaConf
from optuna.trial import TrialState
from physai.sweep import SweepReport

from physai import cli, study
from physai.compose import compose, conf_dir
from physai.config import validate
from physai.errors import UserError
from physai.plots.study import plot_study
from physai.training.config import TrainConfig
from tests.malicious import Pickled

OPTUNA = "hydra/sweeper=optuna"
SPACES = sorted(path.stem for path in (conf_dir() / "hydra" / "search").glob("*.yaml"))


def search(*given):
    return compose("train", [OPTUNA, *given], hydra=True)


def begin(folder, *given, ranges=("seed=range(0,9)",)):
    (folder / "0").mkdir(exist_ok=True)
    return study.begin(folder, search(f"hydra.sweep.dir={folder}", *given), list(ranges), list(given))


def ask(folder, **values):
    """A trial as Hydra's sweeper draws it, with the folder of its run."""
    trial = study.load(folder).ask({"seed": optuna.distributions.IntUniformDistribution(0, 9)})
    (folder / str(trial.number)).mkdir(exist_ok=True)
    return trial


@pytest.mark.parametrize("name", SPACES)
def test_every_value_of_a_search_space_fits_its_algorithm(name):
    chosen = f"algo={name}"
    ranges = study.searched(search(chosen))
    samples = cli._samples([chosen, *ranges])
    assert len(ranges) >= 5
    assert len(samples) >= 3
    for sample in samples:
        validate(TrainConfig, compose("train", sample))


def test_an_algorithm_without_a_search_space_is_searched_where_the_command_line_says():
    config = search()
    config.hydra.runtime.choices.algo = "of_my_own"
    assert study.searched(config, ["seed=range(0,9)"]) == ["seed=range(0,9)"]


def test_what_the_command_line_says_goes_before_the_search_space():
    ranges = study.searched(search("algo=ppo"), ["algo.epochs=3", "algo.loss.clip_epsilon=choice(0.1,0.2)", "seed=1"])
    assert "algo.loss.clip_epsilon=choice(0.1,0.2)" in ranges
    assert not [one for one in ranges if one.startswith(("algo.epochs", "algo.loss.clip_epsilon=interval", "seed"))]


def test_a_sweep_without_optuna_is_no_search_and_refuses_an_interval():
    assert study.searched(compose("train", [], hydra=True)) is None
    with pytest.raises(UserError, match="hydra/sweeper=optuna searches an interval"):
        list(cli._combinations(["seed=interval(0,3)"]))


def test_time_to_target_is_the_first_evaluation_that_has_it(tmp_path):
    (tmp_path / "metrics.csv").write_text(
        "frames,evaluation/success_rate,time/seconds\n1,,0.5\n2,0.7,1.0\n3,0.96,1.5\n4,0.99,2.0\n"
    )
    settings = search("objective=time_to_target").objective
    assert settings.direction == "minimize"
    assert study.objective(tmp_path, settings) == 1.5
    assert study.objective(tmp_path, OmegaConf.merge(settings, {"target": 1.0})) == math.inf


@pytest.mark.parametrize("override", ["objective.target=0.9", "objective.direction=minimize"])
def test_a_search_in_the_wrong_direction_is_refused(override):
    with pytest.raises(UserError, match=r"^objective: a target's time is to be minimized"):
        validate(TrainConfig, compose("train", [override]))


def test_success_is_that_of_the_final_evaluation(tmp_path):
    (tmp_path / "summary.json").write_text(json.dumps({"success_rate": 0.5}))
    assert study.objective(tmp_path, search().objective) == 0.5


def test_the_next_trials_get_the_folders_and_the_seed_that_are_free(tmp_path):
    assert begin(tmp_path, "seed=3") == [
        "hydra.sweeper.n_trials=20",
        "hydra.sweep.subdir='${add:${hydra.job.num},0}'",
        "hydra.sweeper.sampler.seed=3",
    ]
    found = study.load(tmp_path)
    found.tell(ask(tmp_path), 0.5)
    ended = ask(tmp_path)
    found.tell(ended, state=TrialState.FAIL)
    (tmp_path / "1" / "error.txt").write_text("the loss is not finite\n")
    assert begin(tmp_path, "seed=3") == [
        "hydra.sweeper.n_trials=18",
        "hydra.sweep.subdir='${add:${hydra.job.num},2}'",
        "hydra.sweeper.sampler.seed=5",
    ]


def test_a_killed_trial_is_tried_again_unless_its_run_was_complete(tmp_path):
    begin(tmp_path)
    complete, killed = ask(tmp_path), ask(tmp_path)
    (tmp_path / "0" / "summary.json").write_text(json.dumps({"success_rate": 0.75}))
    assert begin(tmp_path)[0] == "hydra.sweeper.n_trials=19"
    trials = study.load(tmp_path).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE", "FAIL", "WAITING"]
    assert trials[0].value == 0.75
    again = ask(tmp_path)
    assert (again.number, again.params) == (2, killed.params)
    assert complete.number == 0


def test_a_study_of_something_else_is_not_gone_on_with(tmp_path):
    begin(tmp_path)
    with pytest.raises(UserError, match="holds a study of something else"):
        begin(tmp_path, ranges=["seed=range(0,3)"])


def test_a_damaged_study_is_named_in_one_line(tmp_path):
    (tmp_path / "study.db").write_text("no database at all" * 100)
    with pytest.raises(UserError, match=r"study\.db: no study can be read there"):
        begin(tmp_path)


def test_trials_without_a_value_are_in_the_report_and_do_not_win(tmp_path, capsys):
    config = search("objective=time_to_target", f"hydra.sweep.dir={tmp_path}")
    (tmp_path / "0").mkdir()
    study.begin(tmp_path, config, ["seed=range(0,9)"], ["threads=1"])
    found = study.load(tmp_path)
    for value in (3.0, math.inf, 2.0, 4.0):
        found.tell(ask(tmp_path), value)
    found.tell(ask(tmp_path), state=TrialState.FAIL)
    (tmp_path / "4" / "error.txt").write_text("the loss is not finite\n")
    SweepReport().on_multirun_end(config)
    output, errors = capsys.readouterr()
    best = found.trials[2].params["seed"]
    assert f"python -m physai.train threads=1 seed={best}" in output
    assert errors == f"error: {tmp_path / '4'}: the loss is not finite\n"
    rows = (tmp_path / "study.csv").read_text().splitlines()
    assert rows[0] == "run,state,seconds to target,seed"
    assert [row.split(",")[1] for row in rows[1:]] == ["complete"] * 4 + ["fail"]
    assert (tmp_path / "study.png").read_bytes().startswith(b"\x89PNG")


def test_a_study_without_any_value_is_drawn_all_the_same(tmp_path):
    begin(tmp_path)
    found = study.load(tmp_path)
    found.tell(ask(tmp_path), math.inf)
    plot_study(found, "success rate", {"seed": "seed"}, tmp_path / "study.png")


def test_a_study_from_elsewhere_may_hold_no_pickle_and_no_key_of_its_own(tmp_path):
    mark = tmp_path / "mark"
    begin(tmp_path)
    trial = ask(tmp_path)
    evil = pickle.dumps(Pickled(f"touch {mark}")).hex()
    storage, number = study.load(tmp_path)._storage, trial._trial_id
    storage.set_trial_system_attr(number, "cma:optimizer:0", evil)
    with pytest.raises(UserError, match=r"study\.db holds a pickle of CMA-ES, which may run anything; yours\? allow="):
        begin(tmp_path)
    assert not mark.exists()
    begin(tmp_path, "allow=[cmaes]")
    other = study.load(tmp_path).ask(
        {"env.task._target_": optuna.distributions.CategoricalDistribution(["evil.Thing"])}
    )
    assert other.params == {"env.task._target_": "evil.Thing"}
    with pytest.raises(UserError, match="holds a study of something else"):
        begin(tmp_path, "allow=[cmaes]")
