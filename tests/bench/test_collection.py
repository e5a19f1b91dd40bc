"""The measurement of collection runs, and shows every figure."""

import pytest
from rich.console import Console

from physai.bench import collection


@pytest.fixture(autouse=True)
def _few_of_all(monkeypatch):
    reacher, few = collection.reacher, ("collector.num_envs=64", "collector.frames_per_batch=256")
    monkeypatch.setattr(collection, "reacher", lambda seed, *overrides: reacher(seed, *overrides, *few))
    monkeypatch.setattr(collection, "ROUNDS", 1)
    monkeypatch.setattr(collection, "STEPS_PER_ROUND", 8)


@pytest.mark.slow
def test_the_bare_loop_one_process_and_two_are_timed_and_shown(monkeypatch):
    monkeypatch.setattr(collection, "ROBOTS", (2,))
    default, speeds = collection.measure_collection(seed=0)
    assert default == 64
    assert set(speeds) == {2, 64}
    assert all(len(sides) == 3 and min(sides) > 0 for sides in speeds.values())
    console = Console(width=120, record=True)
    console.print(collection.collection_table(default, speeds))
    shown = console.export_text()
    for part in ("bare PyBullet", "one process", "two processes", f"{default} (default)"):
        assert part in shown


@pytest.mark.slow
def test_every_collector_is_timed_and_shown(monkeypatch):
    monkeypatch.setattr(collection, "COLLECTORS", ("single", "multi_async"))
    speeds = collection.measure_collectors(seed=0)
    assert all(speed > 0 for speed in speeds.values())
    console = Console(width=120, record=True)
    console.print(collection.collectors_table(speeds))
    for part in ("single", "multi_async", "1.00"):
        assert part in console.export_text(clear=False)
