"""The measurement of policies for identified robots runs, and shows every figure."""

import pytest
from rich.console import Console

from physai.bench import identified
from tests.training.small import TINY


@pytest.mark.slow
def test_policies_for_a_robot_and_for_any_are_trained_and_judged_on_it():
    """Two trainings of seconds: nothing else sees that what is found can be trained with, and judged on its robot."""
    pairs = identified.measure_identified(seed=0, robots=2, episodes=20, seconds=6.0, overrides=TINY)
    assert len(pairs) == 2
    assert all(0 < judged.steps <= 200 and 0 <= judged.settled <= 1 for pair in pairs for judged in pair)
    console = Console(width=160, record=True)
    console.print(identified.identified_table(pairs))
    shown = console.export_text()
    for part in ("steps to goal", "settled, %", "identified", "difference"):
        assert part in shown
