"""The measurement of legs runs for real, at small sizes, and shows every figure."""

import pytest
from rich.console import Console

from physai.bench import walk


@pytest.mark.slow
def test_legs_are_collected_from_and_trained_and_both_are_shown(monkeypatch):
    monkeypatch.setattr(walk, "ROBOTS", (32,))
    monkeypatch.setattr(walk, "ROUNDS", 1)
    speeds = walk.measure_walk(seed=0)
    bare, one, _ = speeds[32]
    assert bare > one > 0  # who only steps is faster
    small = (
        "collector.frames_per_batch=1024",
        "algo.minibatch_size=512",
        "evaluation.goals=2",
        "env.task.max_steps=10",
    )
    run = walk.train_apart(walk.ENV, 2048, 32, 0, walk.ENGINE, *small)
    assert (run.frames, run.robots) == (2048, 32)
    assert 0 < run.learned < run.seconds
    assert 100 < run.megabytes < 10_000
    console = Console(width=120, record=True)
    console.print(walk.walk_table(speeds), walk.training_table([run]))
    shown = console.export_text()
    for part in ("bare MuJoCo", "of bare", "2,048", "peak memory", "waited for batches"):
        assert part in shown
