"""The measurement of start-up runs real commands, and shows every figure."""

import pytest
from rich.console import Console

from physai.bench import startup
from physai.errors import UserError
from tests.training.small import TINY


@pytest.mark.slow
def test_every_wait_is_measured_and_shown(monkeypatch):
    monkeypatch.setattr(startup, "ROUNDS", 1)
    monkeypatch.setattr(startup, "EPISODES", 20)
    monkeypatch.setattr(startup, "TRAINING", TINY)
    seconds = startup.measure_startup(seed=0)
    libraries, package, explained, first_frame, build, passed = (value for (value,) in seconds.values())
    assert package < libraries  # importing physai imports none of them
    assert 0 < explained < first_frame
    assert 0 < build < first_frame
    assert passed > 0
    console = Console(width=120, record=True)
    console.print(startup.startup_table(seconds))
    shown = console.export_text()
    for part in ("import physai", "--help", "first frame", "robots", "one pass", "median"):
        assert part in shown


@pytest.mark.slow
def test_training_that_does_not_start_says_why():
    with pytest.raises(UserError, match=r"training does not start: error: 'seed=\[' is not an override"):
        startup._seconds_to_first_frame(seed="[")
