"""The measurement of growth trains for real, and draws what it finds."""

from dataclasses import replace

import pytest
from rich.console import Console

from physai.bench import growth


@pytest.mark.slow
def test_runs_are_measured_drawn_and_shown(monkeypatch, tmp_path):
    """One run is trained; of the others what it took is said again."""
    train_apart, trained = growth.train_apart, []

    def train(env, frames, robots, seed):
        if not trained:
            trained.append(train_apart(env, frames, robots, seed))
        return replace(trained[0], frames=frames, robots=robots)

    monkeypatch.setattr(growth, "train_apart", train)
    monkeypatch.setattr(growth, "FRAMES", (2048, 6144))
    monkeypatch.setattr(growth, "ROBOTS", (64,))
    monkeypatch.setattr(growth, "ROBOTS_FRAMES", 4096)
    by_frames, by_robots = growth.measure_growth(seed=0)
    assert [(run.frames, run.robots) for run in by_frames + by_robots] == [(2048, 512), (6144, 512), (4096, 64)]
    (run,) = trained
    assert (run.frames, run.robots) == (2048, 512)
    assert run.seconds > 0
    assert 100 < run.megabytes < 10_000
    growth.growth_figure(by_frames, by_robots, tmp_path / "new" / "growth.png")
    assert (tmp_path / "new" / "growth.png").stat().st_size > 10_000
    console = Console(width=120, record=True)
    console.print(growth.growth_table(by_frames, by_robots))
    for part in ("6,144", "peak memory", "MB", "frames/s"):
        assert part in console.export_text(clear=False)
