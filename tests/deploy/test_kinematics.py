"""What a policy file tells of its links: read as it was written, and refused by name where it is impossible."""

import copy
import json

import numpy as np
import pytest

from physai.deploy import PolicyError
from physai.deploy.kinematics import read_kinematics
from physai.robots import RobotSpec, kinematics_of

AT_THE_BODY = np.eye(4).tolist()
STILL = np.zeros((12, 4, 4)).tolist()


@pytest.mark.parametrize("env", ["reacher", "panda_reach", "a1_walk"])
def test_it_is_read_as_it_was_written(env_config, env):
    spec = RobotSpec.from_config(env_config(env).robot)
    written = kinematics_of(spec)
    read = read_kinematics({"kinematics": json.loads(json.dumps(written.describe()))}, len(spec.joints))
    position = spec.sample(3, np.random.default_rng(0))
    np.testing.assert_array_equal(read.motions.frames(position), written.motions.frames(position))
    assert read.height == written.height
    for (body, frame), (other_body, other) in zip(read.ends, written.ends, strict=True):
        assert body == other_body
        np.testing.assert_array_equal(frame, other)


def test_a_file_that_tells_nothing_is_refused():
    with pytest.raises(PolicyError, match=r"metadata: kinematics\.constant is missing"):
        read_kinematics({}, 2)


@pytest.fixture(scope="module")
def legs(env_config):
    return {"kinematics": kinematics_of(RobotSpec.from_config(env_config("a1_walk").robot)).describe()}


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("carriers", [0, 1, 2], "kinematics.carriers must have the shape [12], not [3]"),
        ("carriers", [12] * 12, "carriers must be a body for each joint that comes before it"),
        ("carriers", [0.5] * 12, "bodies must be numbered from 0 to 12"),
        ("carriers", [-1] * 12, "bodies must be numbered from 0 to 12"),
        ("ends", [], "kinematics.ends must be a list of frames"),
        ("ends", [AT_THE_BODY] * 101, "kinematics.ends must be a list of frames"),
        ("ends", [AT_THE_BODY] * 3, "kinematics.end_carriers must have the shape [3], not [4]"),
        ("ends", [[0.0, 0.0, 0.0]] * 4, "kinematics.ends must have the shape [4, 4, 4]"),
        ("ends", [np.full((4, 4), None).tolist()] * 4, "kinematics.ends must be finite"),
        ("ends", [np.full((4, 4), 1e308).tolist()] * 4, "kinematics: a number is beyond 1000"),
        ("end_carriers", [13] * 4, "bodies must be numbered from 0 to 12"),
        ("ends", [np.zeros((4, 4)).tolist()] * 4, "kinematics.ends must be frames"),
        ("ends", [np.diag([1.0, 1.0, -1.0, 1.0]).tolist()] * 4, "kinematics.ends must be frames"),
        ("sine", np.zeros((12, 4, 4)).tolist(), "what a joint does is not a rigid motion"),
        ("constant", np.full((12, 4, 4), 10.0).tolist(), "what a joint does is not a rigid motion"),
        ("height", -1, "kinematics.height must be between 0 and 1000 m"),
        ("height", "tall", "kinematics.height must hold numbers"),
        ("constant", [[1.0]], "kinematics.constant must have the shape [12, 4, 4]"),
    ],
)
def test_what_is_impossible_is_named(legs, key, value, said):
    raw = copy.deepcopy(legs)
    raw["kinematics"][key] = value
    with pytest.raises(PolicyError) as error:
        read_kinematics(raw, 12)
    assert said in str(error.value)


def test_a_joint_that_does_not_turn_is_refused(legs):
    raw = copy.deepcopy(legs)
    raw["kinematics"] |= {"constant": [AT_THE_BODY] * 12, "cosine": STILL, "sine": STILL}
    with pytest.raises(PolicyError, match="a joint does not turn"):
        read_kinematics(raw, 12)


@pytest.mark.parametrize("key", ["carriers", "end_carriers", "ends", "height", "sine"])
def test_what_is_missing_is_named(legs, key):
    raw = copy.deepcopy(legs)
    del raw["kinematics"][key]
    with pytest.raises(PolicyError, match=f"kinematics.{key} is missing"):
        read_kinematics(raw, 12)
