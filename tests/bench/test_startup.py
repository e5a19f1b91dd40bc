"""The measurement of start-up runs real commands, and shows every figure."""

import pytest
from rich.console import Console

from physai.bench import startup
from physai.errors import UserError
from tests.training.small import SMALL


@pytest.mark.slow
def test_every_wait_is_measured_and_shown(monkeypatch):
    monkeypatch.setattr(startup, "ROUNDS", 2)
    monkeypatch.setattr(startup, "EPISODES", 20)
    monkeypatch.setattr(startup, "TRAINING", SMALL)
    seconds = startup.measure_startup(seed=0)
    assert all(len(values) == 2 and min(values) > 0 for values in seconds.values())
    console = Console(width=120, record=True)
    console.print(startup.startup_table(seconds))
    shown = console.export_text()
    for part in ("import physai", "--help", "first frame", "robots", "one pass", "median"):
        assert part in shown


def test_training_that_does_not_start_says_why():
    with pytest.raises(UserError, match=r"(?s)training does not start: .*error: seed: input should be"):
        startup._seconds_to_first_frame(seed=-1)
