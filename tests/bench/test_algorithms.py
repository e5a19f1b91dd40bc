"""Algorithms race against Stable-Baselines3's."""

from dataclasses import replace

import pytest
from rich.console import Console

from physai.bench import algorithms
from physai.bench.algorithms import algorithms_table
from physai.bench.training import Race


def shown(races):
    console = Console(width=200, record=True)
    console.print(algorithms_table(races))
    return console.export_text()


def race(seconds, success_rate):
    return Race("a", 0.95, frames=1000, seconds=seconds, success_rate=success_rate)


def test_the_table_says_who_did_not_arrive():
    text = shown({"sac": (race(10.0, 0.96), race(200.0, 0.5)), "td3": (race(10.0, 0.9), race(20.0, 0.96))})
    sac, td3 = (next(line for line in text.splitlines() if name in line) for name in ("sac", "td3"))
    assert "1,000 / > 1,000" in sac
    assert "> 20x" in sac
    assert "unknown" in td3


@pytest.mark.slow
def test_algorithms_race(monkeypatch):
    monkeypatch.setattr(algorithms, "ALGORITHMS", ("a2c", "td3"))
    monkeypatch.setattr(algorithms, "GOALS", 20)
    monkeypatch.setattr("physai.bench.training.JUDGE_EVERY", 256)
    as_it_comes, reacher = algorithms.sb3.as_it_comes, algorithms.reacher
    monkeypatch.setattr(algorithms.sb3, "as_it_comes", lambda name: replace(as_it_comes(name), frames=256))
    short = ("env.task.max_steps=10", "total_frames=1280")
    monkeypatch.setattr(algorithms, "reacher", lambda seed, *overrides: reacher(seed, *overrides, *short))
    races = algorithms.measure_algorithms(seed=0, peer_seconds=0.1)
    assert list(races) == ["a2c", "td3"]
    for ours, theirs in races.values():
        assert ours.frames >= 1280
        assert theirs.frames >= 256
        assert min(ours.seconds, theirs.seconds) > 0
