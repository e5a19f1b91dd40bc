"""Whole runs at small size: reproducible, interruptible, and stopped by what is not finite."""

import json
import os
import signal
import time
from types import SimpleNamespace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from physai.errors import UserError
from physai.training import callbacks
from physai.training.agent import Agent
from physai.training.checkpoint import load
from physai.training.run import make_trainer, run_training
from tests.training.small import (
    SMALL,
    assert_same_run,
    command,
    metrics,
    resume_here,
    run_here,
    small_config,
    train_here,
)
from tests.waiting import wait_while_runs


def digest(run):
    return json.loads((run / "summary.json").read_text())["weights_sha256"]


def test_a_run_folder_tells_its_whole_story(small_run):
    run, output = small_run, (small_run.parent / "output.txt").read_text()
    summary = json.loads((run / "summary.json").read_text())
    assert {
        "success_rate",
        "success_ci",
        "steps_to_goal",
        "final_distance",
        "return",
        "frames",
        "train_seconds",
        "frames_per_second",
        "weights_sha256",
        "seed",
        "git_commit",
        "randomization",
    } <= set(summary)
    assert summary["frames"] == 8192
    assert (run / "training.png").read_bytes().startswith(b"\x89PNG")
    assert [int(row["frames"]) for row in metrics(run)] == list(range(1024, 8193, 1024))
    assert len((run / "episodes.csv").read_text().splitlines()) > 10
    assert "success rate" in output
    assert "95 % interval" in output
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    assert {
        "episode/return",
        "reward/distance",
        "reward/success",
        "loss_objective",
        "kl_approx",
        "lr",
        "time/frames_per_second",
        "grad_norm",
    } <= set(events.Tags()["scalars"])


@pytest.mark.slow
def test_one_seed_gives_one_run_and_another_seed_another(small_run, tmp_path):
    run = small_run
    same, other = tmp_path / "same", tmp_path / "other"
    for path, seed in ((same, 0), (other, 1)):
        path.mkdir()
        agent = train_here(small_config(f"seed={seed}"), path)
        if path is same:
            assert agent.weights_sha256() == digest(run)
        else:
            assert agent.weights_sha256() != digest(run)
    assert metrics(same) == metrics(run)
    assert (same / "episodes.csv").read_bytes() == (run / "episodes.csv").read_bytes()
    assert metrics(other) != metrics(run)


@pytest.mark.slow
@pytest.mark.parametrize(("collector", "moment"), [("async", 0.0), ("async", "writing"), ("single", 0.1)])
def test_a_run_killed_at_any_moment_and_resumed_ends_like_the_uninterrupted_one(
    small_run, once, tmp_path, collector, moment
):
    whole = small_run
    if collector == "single":
        whole = once("small_run_single", lambda path: run_here(path / "run", *SMALL, "collector=single")) / "run"
    checkpoints = tmp_path / "run" / "checkpoints"
    often = "checkpoint.every_frames=1024"
    process = command("train", *SMALL, often, f"collector={collector}", "hydra.run.dir=run", cwd=tmp_path)
    if moment == "writing":
        wait_while_runs(process, lambda: len(list(checkpoints.glob("0*.pt"))) >= 2)
        while not any(checkpoints.glob(".*.tmp")) and process.poll() is None:
            time.sleep(0.0005)  # it is there for milliseconds; a process that it was missed in ends by itself
    else:
        wait_while_runs(process, (tmp_path / "run" / "metrics.csv").is_file)
        time.sleep(moment)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    resume_here(tmp_path / "run")
    assert_same_run(tmp_path / "run", whole)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_saves_says_how_to_go_on_and_goes_on(small_run, tmp_path, number, code):
    process = command("train", *SMALL, "checkpoint.every_frames=1000000", "hydra.run.dir=run", cwd=tmp_path)
    wait_while_runs(process, (tmp_path / "run" / "metrics.csv").is_file)
    os.kill(process.pid, number)
    output = process.communicate()[0]
    assert process.returncode == code
    assert "python -m physai.train resume=run" in output
    assert len(list((tmp_path / "run" / "checkpoints").glob("0*.pt"))) == 2  # the start, and where it stopped
    resume_here(tmp_path / "run")
    assert_same_run(tmp_path / "run", small_run)


@pytest.fixture
def evaluating(tmp_path):
    """Make a trainer that is due for an evaluation, and what evaluates."""
    made = []

    def make(*overrides):
        config = small_config(*overrides)
        agent, evaluation = Agent.build(config), callbacks.EvaluationCallback(config)
        made.extend([agent, evaluation])
        trainer = make_trainer(config, tmp_path, agent, evaluation)
        trainer.clock.frames = config.total_frames
        return trainer, evaluation

    yield make
    for one in made:
        one.close()


@pytest.mark.slow
def test_robots_for_evaluation_are_made_when_first_needed_and_that_moves_no_random_number(evaluating):
    trainer, evaluation = evaluating()
    assert evaluation._env is None
    batch, before, values = torch.zeros(16, 64), torch.get_rng_state(), [{}, {}]
    for one in values:
        evaluation.after_batch(trainer, batch, one)
    assert torch.equal(torch.get_rng_state(), before)
    assert values[0] == values[1]
    assert {"evaluation/success_rate", "evaluation/return", "evaluation/final_distance"} <= set(values[0])


@pytest.mark.slow
def test_more_goals_than_robots_are_evaluated_in_rounds(evaluating, monkeypatch):
    monkeypatch.setattr(callbacks, "MAX_ROBOTS", 8)
    trainer, evaluation = evaluating("evaluation.goals=20")
    assert len(evaluation._evaluate(trainer).success) == 20
    assert evaluation._env.simulation.num_envs == 8


@pytest.mark.slow
def test_after_a_resume_a_policy_worse_than_the_best_before_does_not_take_its_place(evaluating):
    trainer, evaluation = evaluating()
    batch = torch.zeros(16, 64)
    evaluation.after_batch(trainer, batch, {})
    best = trainer.folder.best.read_bytes()
    evaluation.set_state({"best": [1.0, 1000.0], "best_frames": 7})
    evaluation.after_batch(trainer, batch, {})
    assert trainer.folder.best.read_bytes() == best
    assert evaluation.state() == {"best": [1.0, 1000.0], "best_frames": 7}


@pytest.mark.slow
def test_a_policy_that_stays_at_more_goals_is_better_although_it_missed_one(evaluating, monkeypatch):
    trainer, evaluation = evaluating()
    kept = []
    for number, (success, settled) in enumerate([(1.0, 0.94), (0.995, 0.99), (1.0, 0.9)]):
        result = SimpleNamespace(success_rate=success, settled_rate=settled, mean_error={}, summary=dict)
        result.episode_return = torch.zeros(1)
        monkeypatch.setattr(evaluation, "_evaluate", lambda _, result=result: result)
        trainer.clock.frames = trainer.total_frames + number
        evaluation.after_batch(trainer, torch.zeros(16, 64), {})
        kept.append(evaluation.best_frames - trainer.total_frames)
    assert kept == [0, 1, 1]


@pytest.mark.slow
def test_each_evaluation_normalizes_with_the_statistics_of_its_moment(evaluating):
    trainer, evaluation = evaluating("evaluation.goals=2")
    statistics = trainer.agent.statistics
    for shift in (0.0, 5.0):
        statistics.update(torch.randn(100, 8) + shift)
        evaluation._evaluate(trainer)
        assert torch.equal(evaluation._env.normalizer.loc, statistics.normalizer.loc)
        assert torch.equal(evaluation._env.normalizer.scale, statistics.normalizer.scale)


def test_resuming_a_complete_run_shows_its_result(small_run, capsys):
    run = small_run
    before = digest(run)
    run_training(small_config(), run, resume=True)
    assert "complete already" in capsys.readouterr().out
    assert digest(run) == before


@pytest.mark.slow
def test_a_loss_that_explodes_stops_the_run_and_keeps_the_evidence(tmp_path):
    config = small_config("algo.optimizer.lr=1e30", "algo.scheduler=null")
    with pytest.raises(UserError, match=r"iteration \d+: .* is not finite") as stopped:
        train_here(config, tmp_path)
    evidence = load(tmp_path / "not_finite.pt")
    assert "observation" in str(evidence["batch"].keys())
    kept = sorted((tmp_path / "checkpoints").glob("0*.pt"))[-1]
    assert str(kept) in str(stopped.value)
    weights = load(kept)["actor"]
    assert all(torch.isfinite(value).all() for value in weights.values())


@pytest.mark.slow
def test_a_simulation_that_is_not_finite_stops_the_run(tmp_path, monkeypatch):
    from physai.envs.simulation import Simulation

    reset = Simulation.reset
    calls = 0

    def poisoned(self, rows=None, parameters=None):
        nonlocal calls
        calls += self.num_envs == 32  # those that are learned from; 16 are evaluated
        reset(self, rows, parameters)
        if calls == 2:  # a broken model would do the same to the joint states
            self.physics.set_state(
                self.physics.state() | {"joint_velocity": self.physics.state()["joint_velocity"] * float("nan")}
            )
            self.state = self.physics.robot_state()

    monkeypatch.setattr(Simulation, "reset", poisoned)
    with pytest.raises(UserError, match=r"iteration \d+: .*from the simulation is not finite"):
        train_here(small_config("collector=single", "collector.num_envs=32"), tmp_path)
    assert (tmp_path / "not_finite.pt").is_file()


FULL_DISK = """
import resource
from pathlib import Path
from physai.errors import UserError
from physai.training.trainer import Trainer
from tests.training.small import small_config, train_here
save = Trainer.save
def limited(self):
    if self.clock.frames >= 4096:
        resource.setrlimit(resource.RLIMIT_FSIZE, (9_000, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    save(self)
Trainer.save = limited
try:
    train_here(small_config(), Path("run"))
except UserError as error:
    print("user error:", error)
"""


@pytest.mark.slow
def test_a_full_disk_ends_the_run_in_one_line_with_the_last_good_checkpoint_kept(tmp_path, pytestconfig):
    import subprocess
    import sys

    (tmp_path / "run").mkdir()
    environment = os.environ | {"PYTHONPATH": str(pytestconfig.rootpath)}
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert "user error: cannot write to run: File too large" in done.stdout, done.stderr[-2000:]
    kept = sorted((tmp_path / "run" / "checkpoints").glob("0*.pt"))
    assert int(kept[-1].stem) == 2048
    assert load(kept[-1])["frames"] == 2048
