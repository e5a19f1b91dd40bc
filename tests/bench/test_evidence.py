"""Ways to train are judged on robots that nobody has met, and what lies there already is not made again."""

import json
import shutil

import numpy as np
import pytest
from rich.console import Console

from physai.bench import evidence
from tests.training.small import TINY


@pytest.fixture(autouse=True)
def _few_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"ROBOTS": 3, "GOALS": 2, "KNOWN": 2, "KNOWN_GOALS": 2, "NOMINAL_GOALS": 4, "GRID": 2, "CELL": 2}
    for name, size in {**sizes, "SECONDS": 3.0, "WAYS": {"default": ("randomization=default",)}}.items():
        monkeypatch.setattr(evidence, name, size)


@pytest.mark.slow
def test_every_way_is_judged_on_every_kind_of_robot_and_a_run_that_lies_there_is_kept(exported_run, tmp_path):
    """One training of seconds, and policies that were there: it is the judging that nothing else sees."""
    for name in ("teacher", "adaptive", "reacher_robot0", "reacher_robot1"):
        shutil.copytree(exported_run, tmp_path / "reacher_seed0" / name)
    for robot in range(2):
        (tmp_path / f"reacher_robot{robot}").mkdir()
        (tmp_path / f"reacher_robot{robot}" / "identified.yaml").touch()
    found = evidence.measure_evidence(0, 1, tmp_path, ("reacher",), TINY)
    assert list(found["reacher"]) == ["default", "adaptive", "identified, drives"]
    for shown in (each for ways in found["reacher"].values() for each in ways):
        assert [len(judged.settled) for judged in shown.on.values()] == [1, 3, 2]
        assert all(0 <= rate <= 1 for judged in shown.on.values() for rate in (*judged.success, *judged.settled))
        assert 0 <= shown.works <= 1
    adaptive, own = (found["reacher"][way][0].on for way in ("adaptive", "identified, drives"))
    assert adaptive == own  # one policy on the same robots, with the same goals
    assert json.loads((tmp_path / "evidence.json").read_text())["reacher"]["default"][0]["works"] == (
        found["reacher"]["default"][0].works
    )
    assert (tmp_path / "reacher_seed0" / "stress.png").stat().st_size > 10_000
    console = Console(width=180, record=True)
    console.print(evidence.evidence_table(found))
    shown = console.export_text()
    for part in ("reacher, the robot as described", "reacher, 3 hidden robots", "adaptive", "identified, drives"):
        assert part in shown


def test_each_robot_of_a_fleet_gets_the_same_number_of_episodes_one_after_the_other(reacher):
    from physai.bench.timing import config_of
    from physai.physics import ParameterLayout
    from physai.robots import RobotSpec

    draws = config_of("reacher", 0, "randomization=strong").randomization
    layout = ParameterLayout(RobotSpec.from_config(reacher.robot))
    robots = np.concatenate([evidence.draw(draws, layout, seed) for seed in range(3)])
    fleet = evidence.Fleet.among(draws, robots)
    drawn = fleet.sample(6, layout, None).numpy()
    np.testing.assert_array_equal(drawn, robots.astype(np.float32)[[0, 0, 1, 1, 2, 2]])
    np.testing.assert_array_equal(fleet.only(1).sample(2, layout, None).numpy(), robots.astype(np.float32)[[1, 1]])
