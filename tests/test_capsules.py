"""The command that fits capsules, on an arm of two bars that can fold onto its base."""

import re

import numpy as np
import pytest
from omegaconf import OmegaConf

from physai.physics.shapes import ShapeCollisions
from physai.robots import RobotConfig, RobotSpec
from tests.robots.test_collision import changed, config_of

LINK = """<link name="{name}">
  <inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
  {collision}
</link>"""
JOINT = """<joint name="{name}" type="revolute">
  <parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="50" velocity="2"/>
</joint>"""
BAR = '<collision><origin xyz="0 0 0.2"/><geometry><box size="0.06 0.06 0.4"/></geometry></collision>'
FOOT = '<collision><geometry><cylinder radius="0.1" length="0.1"/></geometry></collision>'


def write_arm(folder, *collisions: str):
    names = ("foot", "upper", "fore", "hand")
    links = [LINK.format(name=name, collision=shape) for name, shape in zip(names, collisions, strict=True)]
    joints = [
        JOINT.format(name="shoulder", parent="foot", child="upper", xyz="0 0 0.2"),
        JOINT.format(name="elbow", parent="upper", child="fore", xyz="0 0 0.4"),
        '<joint name="wrist" type="fixed"><parent link="fore"/><child link="hand"/><origin xyz="0 0 0.4"/></joint>',
    ]
    path = folder / "arm.urdf"
    path.write_text(f"<robot name='arm'>{''.join(links + joints)}</robot>")
    return path


def overrides(path, **more: object) -> list[str]:
    given = {
        "robot": "planar_arm",
        "robot.name": "folding",
        "robot.urdf": path,
        "robot.joints": "[shoulder,elbow]",
        "robot.end_effector": "hand",
        "samples": 500,
        **more,
    }
    return [f"{key}={value}" for key, value in given.items()]


def folding(path, collision: dict | None) -> RobotSpec:
    given = {"name": "folding", "urdf": str(path), "joints": ["shoulder", "elbow"], "end_effector": "hand"}
    return changed(RobotConfig.model_validate({**config_of("planar_arm").model_dump(), **given}), collision)


def test_capsules_are_written_and_drawn_and_a_robot_takes_them(tmp_path, run):
    path = write_arm(tmp_path, FOOT, BAR, BAR, "")
    code, said, error = run("capsules", *overrides(path, output="found.yaml"))
    assert code == 0, error
    assert "capsules miss 0.00% of these" in said
    assert (tmp_path / "found.png").read_bytes().startswith(b"\x89PNG")
    spec = folding(path, OmegaConf.to_container(OmegaConf.load(tmp_path / "found.yaml")))
    assert set(spec.collision.names) == {("foot", "fore")}
    positions = spec.sample(500, np.random.default_rng(5))
    judge = ShapeCollisions(spec)
    touching = judge.touching(positions)
    judge.close()
    alarm = (spec.collision.distance(positions) <= 0).any(axis=1)
    assert touching.any()
    assert not (touching & ~alarm).any()
    assert (alarm & ~touching).mean() < 0.08


@pytest.mark.slow
def test_links_that_capsules_cannot_tell_apart_are_left_out_and_named(tmp_path, run):
    disc = FOOT.replace("<geometry>", '<origin xyz="0 0 {z}" rpy="1.5708 0 0"/><geometry>')
    path = write_arm(tmp_path, disc.format(z=0.2), "", disc.format(z=0.0), "")
    path.write_text(path.read_text().replace('<origin xyz="0 0 0.4"/><axis', '<origin xyz="0 0.11 0"/><axis'))
    code, said, error = run("capsules", *overrides(path, output="found.yaml"))
    assert code == 0, error
    assert "Left out: foot and fore, whose capsules overlap nearly always. Their shapes touch in 0.0%" in said
    assert OmegaConf.load(tmp_path / "found.yaml").pairs == []


def test_a_robot_on_which_nothing_can_meet_gets_capsules_without_pairs(tmp_path, run):
    path = write_arm(tmp_path, "", BAR, BAR, "")
    code, _, error = run("capsules", *overrides(path, output="found.yaml"))
    assert code == 0, error
    assert OmegaConf.load(tmp_path / "found.yaml").pairs == []


@pytest.mark.parametrize(
    ("collisions", "more", "words"),
    [
        (("", "", "", ""), {}, "arm.urdf: no link has a <collision>, so there is nothing to fit capsules to"),
        ((FOOT, BAR, BAR, ""), {"output": "found.json"}, "output: 'found.json' must end in .yaml"),
        ((FOOT, BAR, BAR, ""), {"near": -1.0}, "near: input should be greater than 0, got -1.0"),
        ((FOOT, BAR, BAR.replace("box", "cone"), ""), {}, "link 'fore': its <collision> is a <cone>, not a mesh"),
    ],
)
def test_what_cannot_be_fitted_ends_in_one_line(collisions, more, words, tmp_path, run):
    path = write_arm(tmp_path, *collisions)
    code, _, error = run("capsules", *overrides(path, **{"output": "found.yaml", **more}))
    assert code == 2
    assert re.fullmatch(f"error: .*{re.escape(words)}.*\n", error)
    assert not (tmp_path / "found.yaml").exists()
