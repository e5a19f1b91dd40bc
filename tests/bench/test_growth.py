"""The measurement of growth trains for real, and draws what it finds."""

from dataclasses import replace

import pytest
from rich.console import Console

from physai.bench import growth


@pytest.mark.slow
def test_runs_are_measured_drawn_and_shown(monkeypatch, tmp_path):
    monkeypatch.setattr(growth, "FRAMES", ())
    monkeypatch.setattr(growth, "ROBOTS", (64,))
    monkeypatch.setattr(growth, "ROBOTS_FRAMES", 2048)
    by_frames, (run,) = growth.measure_growth(seed=0)
    assert by_frames == []
    assert (run.frames, run.robots) == (2048, 64)
    assert run.seconds > 0
    assert 100 < run.megabytes < 10_000
    by_frames, by_robots = [run, replace(run, frames=6144, seconds=2 * run.seconds)], [run]
    growth.growth_figure(by_frames, by_robots, tmp_path / "new" / "growth.png")
    assert (tmp_path / "new" / "growth.png").stat().st_size > 10_000
    console = Console(width=120, record=True)
    console.print(growth.growth_table(by_frames, by_robots))
    for part in ("6,144", "peak memory", "MB", "frames/s"):
        assert part in console.export_text(clear=False)
