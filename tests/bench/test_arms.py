"""A Panda's learners race, and what hindsight replay is told agrees with what its envs show."""

import gymnasium
import numpy as np
import pytest
import torch
from rich.console import Console

import physai  # noqa: F401 (registers the ids)
from physai.bench import arms
from physai.bench.arms import arms_table
from physai.bench.sb3 import _with_goals
from physai.bench.training import Race

HINDSIGHT = "TQC + HER"


@pytest.fixture(autouse=True)
def _torch_stays_as_it_is():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def rows(races, ours):
    console = Console(width=200, record=True)
    console.print(arms_table(races, ours))
    lines = [line for line in console.export_text().splitlines() if "│" in line]
    return {line.split("│")[1].strip(): [cell.strip() for cell in line.split("│")[2:-1]] for line in lines}


def race(name, seconds, success_rate=1.0):
    return Race(name, arms.TARGET, frames=1000, seconds=seconds, success_rate=success_rate)


def test_the_table_says_what_each_of_ours_is_ahead_by_and_who_reached_the_limit():
    shown = rows([race("a", 10.0), race("b", 5.0), race("c", 40.0), race("d", 220.0, 0.5)], 2)
    assert shown["a"] == ["1,000", "10.0 s", "100.0%", "", ""]
    assert shown["c"] == ["1,000", "40.0 s", "100.0%", "4.0x", "8.0x"]
    assert shown["d"] == ["> 1,000", "> 220.0 s", "50.0%", "> 22.0x", "> 44.0x"]


def test_a_limit_that_was_reached_is_named():
    console = Console(width=200, record=True)
    console.print(arms_table([race("a", 10.0), race("c", 40.0, 0.5)], 1))
    assert "stopped at its limit" in console.export_text()


def test_who_does_not_arrive_is_ahead_of_nobody():
    assert rows([race("a", 10.0, 0.5), race("c", 40.0)], 1)["c"][-1] == "unknown"


def test_a_policy_is_told_while_it_is_judged_what_its_env_shows():
    env = gymnasium.make("physai/PandaReachGoal-v0")
    shown, _ = env.reset(seed=0)
    told = _with_goals(env.unwrapped.simulation.observe(), env.observation_space)
    assert list(told) == list(shown)
    for key, value in shown.items():
        np.testing.assert_allclose(told[key][0], value, atol=1e-6)
    env.close()


@pytest.mark.slow
def test_it_learns_with_goals_in_hindsight():
    """What only learning from such a buffer shows: that our env answers what it asks for, and predictions fit it."""
    learner = arms.PEERS[HINDSIGHT].learner(seed=0, learning_starts=200)  # past the end of the first episode
    seen = torch.zeros(3, 20)
    before = learner.act(seen)
    assert [learner.learn(), learner.learn()] == [128, 128]
    after = learner.act(seen)
    assert after.shape == (3, 7)
    assert after.abs().max() <= 1
    assert not torch.equal(before, after)
    learner.close()


@pytest.mark.slow
def test_arms_race(monkeypatch):
    """As in the real race, with less of everything, in one process; panda-gym's robot among them."""
    monkeypatch.setattr(arms, "apart", lambda race, *arguments: race(*arguments))  # tests/bench/test_training.py
    monkeypatch.setattr(arms, "OURS", {"physai": ()})
    monkeypatch.setattr(arms, "PEERS", {name: arms.PEERS[name] for name in arms.PEERS if "PPO" not in name})
    races = arms.measure_arms(0, times=0.01, goals=10, overrides=("env.task.max_steps=10", "total_frames=2048"))
    assert [one.name for one in races] == ["physai", *arms.PEERS]
    for one in races:
        assert one.frames >= 128
        assert one.seconds > 0
    assert list(rows(races, 1)) == [one.name for one in races]
