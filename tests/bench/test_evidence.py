"""Ways to train are judged on robots that nobody has met, and what lies there already is not made again."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from rich.console import Console

from physai.bench import evidence
from tests.training.small import TINY


@pytest.fixture(autouse=True)
def _few_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"ROBOTS": 3, "GOALS": 2, "KNOWN": 2, "KNOWN_GOALS": 2, "NOMINAL_GOALS": 4, "GRID": 2, "CELL": 2}
    for name, size in {**sizes, "SECONDS": 3.0, "WAYS": {"default": ("randomization=default",)}}.items():
        monkeypatch.setattr(evidence, name, size)


@pytest.mark.slow
def test_every_way_is_judged_on_every_kind_of_robot_and_a_run_that_lies_there_is_kept(
    exported_run, tmp_path, monkeypatch
):
    """One training of seconds, and policies that were there: it is the judging that nothing else sees."""
    for robot in range(2):
        (tmp_path / f"reacher_robot{robot}").mkdir()
        (tmp_path / f"reacher_robot{robot}" / "identified.yaml").touch()
    trained, command = [], evidence._command

    def as_if(module, *overrides):
        """Train for real in the first way; in the others take what is there."""
        folder = Path(overrides[-1].partition("=")[2])
        trained.append(folder.name)
        if folder.name == "default":
            command(module, *overrides)
        else:
            shutil.copytree(exported_run, folder)

    monkeypatch.setattr(evidence, "_command", as_if)
    found = evidence.measure_evidence(0, 1, tmp_path, ("reacher",), TINY)
    assert trained == ["default", "teacher", "adaptive", "tuned", "reacher_robot0", "reacher_robot1"]
    assert list(found["reacher"]) == ["default", "adaptive, drives", "adaptive, fine-tuned", "identified, drives"]
    for shown in (each for ways in found["reacher"].values() for each in ways):
        assert [len(judged.settled) for judged in shown.on.values()] == [1, 3, 2]
        assert all(0 <= rate <= 1 for judged in shown.on.values() for rate in (*judged.success, *judged.settled))
        assert 0 <= shown.works <= 1
    adaptive, own = (found["reacher"][way][0].on for way in ("adaptive, drives", "identified, drives"))
    assert adaptive == own  # one policy on the same robots, with the same goals
    assert json.loads((tmp_path / "evidence.json").read_text())["reacher"]["default"][0]["works"] == (
        found["reacher"]["default"][0].works
    )
    assert (tmp_path / "reacher_seed0" / "stress.png").stat().st_size > 10_000
    again = evidence._train(tmp_path / "reacher_seed0" / "default", *_overrides(tmp_path / "reacher_seed0" / "default"))
    assert again.name == "default"
    assert len(trained) == 6
    console = Console(width=180, record=True)
    console.print(evidence.evidence_table(found))
    shown = console.export_text()
    for part in (
        "reacher, the robot as described",
        "reacher, 3 hidden robots",
        "adaptive, drives",
        "identified, drives",
    ):
        assert part in shown


def _overrides(run: Path) -> list[str]:
    return list(OmegaConf.load(run / ".hydra" / "overrides.yaml"))


def test_episodes_are_sorted_by_robot():
    two = SimpleNamespace(
        success=torch.tensor([True, True, True, False]),
        settled=torch.tensor([True, False, False, False]),
        length=torch.tensor([10, 20, 30, 50]),
        action_change=torch.tensor([[0.0, 2.0], [0.0, 2.0], [1.0, 3.0], [1.0, 3.0]]),
    )
    judged = evidence.Judged.of([two], 2)
    assert (judged.success, judged.settled) == ([1.0, 0.5], [0.5, 0.0])
    assert (judged.steps, judged.change) == ([15.0, 40.0], [1.0, 2.0])


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
