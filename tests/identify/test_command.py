"""The command: a table, a file, and one line for what is wrong."""

import json
import os

import numpy as np
import pytest
import torch

from physai.bench.hidden import NOISE, record, write_table
from physai.compose import compose
from physai.config import validate
from physai.physics import RandomizationConfig
from tests.composed import randomization


@pytest.fixture(scope="module")
def hidden(env_config):
    draws = randomization("strong")
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
    assert os.environ["OMP_NUM_THREADS"] == "1"  # with as many threads of MuJoCo as there are cores
    assert "95 % interval" in output
    assert "the noise of the sensors explains them" in output
    folder = table.with_name("robot_identified")
    assert sorted(path.name for path in folder.iterdir()) == [
        f"identified.{kind}" for kind in ("json", "png", "txt", "yaml")
    ]
    assert "95 % interval" in (folder / "identified.txt").read_text()
    written = json.loads((folder / "identified.json").read_text())
    assert written["actuator_delay"] == hidden.delay
    assert written["explained"]
    for joint, truth in zip(hidden.spec.joints, hidden.parameters[hidden.layout.columns["velocity_gain"]], strict=True):
        found = written["parameters"][f"velocity_gain[{joint}]"]
        assert found["told"]
        assert abs(found["value"] - truth) < 0.02
    # What it wrote is a randomization to train with, from whichever folder.
    node = compose("train", [f"randomization={folder}/identified.yaml"])
    draws = validate(RandomizationConfig, node.randomization)
    drawn = draws.sample(100, hidden.layout, torch.Generator().manual_seed(0)).numpy()
    columns = hidden.layout.columns["velocity_gain"]
    assert (np.abs(drawn[:, columns] - hidden.parameters[columns]) < 0.05).all()
    assert (drawn[:, hidden.layout.columns["actuator_delay"]] == hidden.delay).all()
    np.testing.assert_allclose(drawn[:, hidden.layout.columns["position_noise"]].mean(), NOISE[0], rtol=0.25)


@pytest.mark.slow
def test_what_may_explain_more_is_named_until_it_was_tried(run, env_config, tmp_path):
    """Motors like PyBullet's do not explain a drive with heavy rotors; drives do, when the rotors are looked for."""
    real = env_config("reacher", "physics=mujoco", "physics.motor=servo", "env.robot.armature=0.05")
    hidden = record(real, randomization("none"), [], 8.0, 2)
    write_table(hidden.recording, hidden.spec.joints, tmp_path / "robot.csv")
    fast = ("data=robot.csv", "delays=0")
    drive = (*fast, "physics=mujoco", "physics.motor=servo")
    _, as_pybullet, _ = run("identify", *fast, "fit=[velocity_gain]")
    assert "Not tried: the motors of a drive (physics=mujoco physics.motor=servo)." in as_pybullet
    _, without_rotors, _ = run("identify", *drive, "fit=[velocity_gain]")
    assert "Not tried: the inertia of its rotors" in without_rotors
    _, explained, _ = run("identify", *drive, "fit=[velocity_gain,armature]")
    assert "the noise of the sensors explains them" in explained
    assert "Not tried" not in explained
    assert (
        "physai.train env=reacher physics=mujoco physics.motor=servo physics.motor_time_constant=0.015 randomization="
        in (explained.replace("\n", " "))
    )


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["data=nowhere.csv"], "nowhere.csv: No such file or directory"),
        (["data=robot.csv", "fit=[link_mas]"], "fit: 'link_mas' is none of link_mass, payload"),
        (["data=robot.csv", "fit=[]"], "fit: "),
        (
            ["data=robot.csv", "fit=[link_mass,effort_limit]"],
            "fit: effort_limit does not show in robot.csv, which has no",
        ),
        (["data=robot.csv", "threads=0"], "threads: "),
        (
            ["data=robot.csv", "physics=pybullet", "env.robot.armature=0.1"],
            "robot 'planar_arm': PyBullet has no rotors",
        ),
        (["data=robot.csv", "physics=pybullet", "fit=[armature]"], "fit: this engine cannot change 'armature'"),
        (["data=robot.csv", "env=kuka_reacher"], "robot.csv: it has no column 'position[lbr_iiwa_joint_1]'"),
        (["data=robot.csv", "output=robot.csv"], "output: robot.csv is no folder"),
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
