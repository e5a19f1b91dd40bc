"""The measurement of the engines runs, and shows every figure."""

import pytest
from rich.console import Console

from physai.bench import engines


@pytest.mark.slow
def test_every_engine_is_timed_with_every_arm_and_shown(monkeypatch):
    monkeypatch.setattr(engines, "ROBOTS", (2,))
    monkeypatch.setattr(engines, "ROUNDS", 1)
    monkeypatch.setattr(engines, "ROBOT_STEPS", 8)
    speeds = engines.measure_engines(seed=0)
    assert set(speeds) == {(arm, 2) for arm in engines.ARMS}
    assert all(len(sides) == len(engines.ENGINES) and min(sides) > 0 for sides in speeds.values())
    console = Console(width=160, record=True)
    console.print(engines.engines_table(speeds))
    shown = console.export_text()
    for part in (*engines.ENGINES, "KUKA, 7 joints, 2"):
        assert part in shown
