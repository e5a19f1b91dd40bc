"""The largest box of a randomization in which a policy settles."""

import json
import shutil

import pytest

from physai.stress.box import Box, bisect
from tests.training.small import command


@pytest.mark.parametrize(("edge", "expected"), [(0.0, 0.0), (0.3, 0.3), (0.999, 0.999), (1.0, 1.0)])
def test_the_edge_is_found_from_inside(edge, expected):
    share, count = bisect(lambda share: 95 if share <= edge else 94, 95)
    assert count == 95
    assert expected - 1 / 256 <= share <= expected


def test_where_too_few_settle_as_described_there_is_no_box():
    assert bisect(lambda share: 90 - int(10 * share), 95) == (0.0, 90)


def test_its_volume_is_a_part_of_that_of_the_whole_ranges():
    assert Box("wide", 0.5, 95, 100, 10).volume == pytest.approx(0.5**10)


@pytest.mark.slow
def test_the_command_writes_the_box_of_a_run(exported_run, tmp_path):
    """Twenty seconds: nothing else shows that the command, its policy and growing ranges fit together."""
    for part in ("checkpoints", ".hydra"):
        shutil.copytree(exported_run / part, tmp_path / "run" / part)
    options = ("box=true", "randomization=wide", "episodes=10", "env=reacher", "env.task.max_steps=40")
    process = command("stress", "run=run", *options, cwd=tmp_path)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    box = json.loads((tmp_path / "run" / "box_wide.json").read_text())
    assert (box["randomization"], box["robots"], box["parameters"]) == ("wide", 10, 10)
    assert box["volume"] == pytest.approx(box["share"] ** 10)
