"""The measurement of identifications runs, and shows every figure."""

import pytest
from rich.console import Console

from physai.bench import identify


@pytest.mark.slow
def test_hidden_robots_are_found_and_shown(monkeypatch):
    cases = ("PyBullet in MuJoCo", "drives as PyBullet's motors")
    monkeypatch.setattr(identify, "CASES", {case: identify.CASES[case] for case in cases})
    found = identify.measure_identify(seed=1, robots=1, seconds=6.0)
    assert {case: len(each) for case, each in found.items()} == dict.fromkeys(cases, 1)
    same, other = found[cases[0]][0], found[cases[1]][0]
    assert same.fit.explained
    assert not other.fit.explained
    assert same.noise < 1.5 < other.noise
    assert other.better > 1.0
    assert same.held.size > 0
    console = Console(width=200, record=True)
    console.print(identify.identify_table(found))
    shown = console.export_text()
    for part in (*found, "link mass", "held out"):
        assert part in shown
