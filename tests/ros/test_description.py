"""The URDF of a policy file: its links are where the policy's own kinematics say, and anybody's parser reads it."""

import numpy as np
import pytest
from omegaconf import DictConfig
from scipy.spatial.transform import Rotation
from urdf_parser_py.urdf import Robot

from physai.config import validate
from physai.deploy import load_policy
from physai.envs.simulation import EnvConfig
from physai.robots import RobotSpec
from physai.ros.topics.description import LinkFrames, urdf
from physai.web.described import Described


def place(frames: LinkFrames, positions: dict[str, float], link: str) -> np.ndarray:
    """Where a link is in the world, 4 x 4."""
    steps = {transform.child: transform for transform in frames.at(positions)}
    found = np.eye(4)
    while link != "world":
        step = steps[link]
        here = np.eye(4)
        here[:3, :3], here[:3, 3] = Rotation.from_quat(step.orientation).as_matrix(), step.position
        found, link = here @ found, step.parent
    return found


@pytest.mark.parametrize("run", ["exported_run", "panda_run"])
def test_its_tip_is_where_the_policy_reaches_its_goal(run, request):
    policy = load_policy(request.getfixturevalue(run) / "policy.pt")
    joints, size = policy.metadata.joints, policy.metadata.goal.size
    frames = LinkFrames(urdf(policy.metadata, "arm1/"))
    assert frames.joints == list(joints)
    random = np.random.default_rng(0)
    for _ in range(10):
        angles = random.uniform(-1.5, 1.5, len(joints))
        tip = place(frames, dict(zip(joints, angles, strict=True)), "arm1/tip")[:3, 3]
        assert policy.error(angles, tip[:size])[0] < 1e-5


@pytest.mark.parametrize("run", ["exported_run", "panda_run"])
def test_another_parser_reads_it(run, request):
    metadata = load_policy(request.getfixturevalue(run) / "policy.pt").metadata
    robot = Robot.from_xml_string(urdf(metadata, ""))
    assert [joint.name for joint in robot.joints if joint.type == "revolute"] == list(metadata.joints)
    assert robot.get_root() == "world"
    assert sum(len(link.visuals) for link in robot.links) > len(metadata.joints)


def test_legs_stand_on_the_floor_and_their_feet_are_where_the_robot_has_them(walking_policy):
    metadata = walking_policy.metadata
    env = validate(EnvConfig, DictConfig(metadata.raw["config"]["env"]))
    spec = RobotSpec.from_config(env.robot)
    text = urdf(metadata, "")
    frames, robot = LinkFrames(text), Robot.from_xml_string(text)
    assert (frames.joints, robot.get_root()) == (list(metadata.joints), "world")
    at_home = dict(zip(metadata.joints, spec.home, strict=True))
    feet = [link.name for link in robot.links if link.name.startswith("foot")]
    assert len(feet) == 4
    heights = [place(frames, at_home, foot)[2, 3] for foot in feet]
    assert heights == pytest.approx([0.02] * 4, abs=0.02)  # a foot is a ball of 2 cm
    described = Described.read(text)
    assert set(described.joints) == set(metadata.joints)
    position = np.random.default_rng(0).uniform(-0.5, 0.5, 12)
    by_name = dict(zip(metadata.joints, position, strict=True))
    drawn = described.appearance.frames(np.array([by_name[joint] for joint in described.joints]))
    for joint, frame in zip(described.joints, drawn[1:], strict=True):
        assert frame == pytest.approx(place(frames, by_name, f"{joint}_body")[:3], abs=1e-6)


def test_it_may_come_from_anybody():
    text = """<robot name="x"><link name="a"/><link name="b"/><joint name="j" type="continuous">
      <parent link="a"/><child link="b"/><origin xyz="0 0 1"/><axis xyz="0 0 2"/></joint></robot>"""
    (step,) = LinkFrames(text).at({"j": np.pi / 2})
    assert (step.parent, step.child, step.position) == ("a", "b", (0.0, 0.0, 1.0))
    assert step.orientation == pytest.approx((0, 0, 2**-0.5, 2**-0.5))
    for bad in ("", "<robot><joint/></robot>", "<robot>", text.replace("0 0 1", "0 0")):
        with pytest.raises(ValueError, match="no URDF"):
            LinkFrames(bad)
