"""The command: a table, a file, and one line for what is wrong."""

import json

import pytest

from physai.compose import compose
from physai.config import validate
from physai.physics import RandomizationConfig
from tests.identify.hidden import record, write_table


@pytest.fixture(scope="module")
def hidden(env_config):
    draws = validate(RandomizationConfig, compose("train", ["randomization=strong"]).randomization)
    return record(env_config("reacher", "physics=mujoco"), draws, ["velocity_gain"], 10.0, 2)


@pytest.fixture
def table(hidden, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_table(hidden.recording, hidden.spec.joints, tmp_path / "robot.csv")
    return tmp_path / "robot.csv"


@pytest.mark.slow
def test_it_shows_and_writes_what_was_found(run, table, hidden):
    code, output, error = run("identify", "data=robot.csv", "fit=[velocity_gain,joint_damping]", "delays=2")
    assert code == 0, error
    assert "95 % interval" in output
    assert "the noise of the sensors explains them" in output
    written = json.loads(table.with_name("robot.csv.identified.json").read_text())
    assert written["actuator_delay"] == hidden.delay
    assert written["explained"]
    for joint, truth in zip(hidden.spec.joints, hidden.parameters[hidden.layout.columns["velocity_gain"]], strict=True):
        found = written["parameters"][f"velocity_gain[{joint}]"]
        assert found["told"]
        assert abs(found["value"] - truth) < 0.02


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["data=nowhere.csv"], "nowhere.csv: No such file or directory"),
        (["data=robot.csv", "fit=[link_mas]"], "fit: 'link_mas' is none of link_mass, payload"),
        (["data=robot.csv", "fit=[]"], "fit: "),
        (["data=robot.csv", "env=kuka_reacher"], "robot.csv: it has no column 'position[lbr_iiwa_joint_1]'"),
        (["data=robot.csv", "output=found.txt"], "output: 'found.txt' must end in .json"),
        (["data=robot.csv", "delays=-1"], "delays: "),
        (["fit=[link_mass]"], "data"),
    ],
)
def test_bad_input_ends_in_one_line_before_anything_is_written(run, table, arguments, line):
    code, _, error = run("identify", *arguments)
    assert code == 2
    assert line in error
    assert len(error.strip().splitlines()) == 1
    assert [path.name for path in table.parent.iterdir()] == ["robot.csv"]
