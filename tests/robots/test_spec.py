"""A robot's limits are those of each joint, and its signals follow from them."""

import numpy as np
import pytest

from physai.compose import compose
from physai.config import validate
from physai.envs.simulation import EnvConfig
from physai.errors import UserError
from physai.robots import RobotConfig, RobotSpec
from physai.signals import Quantity
from tests.composed import env_config

CONFIG = env_config("reacher").robot


def spec_of(**changes: object) -> RobotSpec:
    return RobotSpec.from_config(RobotConfig.model_validate({**CONFIG.model_dump(), **changes}))


def test_sensors_are_signals_with_the_limits_of_each_joint():
    spec = spec_of()
    assert spec.joint_position.labels == spec.joint_velocity.labels == ("joint1", "joint2")
    np.testing.assert_array_equal(spec.joint_position.bounds, [[-np.inf, -2.6], [np.inf, 2.6]])
    np.testing.assert_array_equal(spec.joint_velocity.bounds, [[-2.5, -2.5], [2.5, 2.5]])
    assert (spec.joint_position.unit, spec.joint_velocity.unit) == ("rad", "rad/s")


def test_a_velocity_command_is_bounded_by_what_an_action_may_ask_of_each_joint():
    spec = spec_of(command_limit=[2.0, 0.5])
    assert spec.command is Quantity.JOINT_VELOCITY
    assert spec.joint_command.name == "joint_velocity_command"
    np.testing.assert_array_equal(spec.joint_command.bounds, [[-2.0, -0.5], [2.0, 0.5]])
    assert spec.joint_command.unit == "rad/s"


def test_a_position_command_is_bounded_by_the_limits_of_each_joint():
    spec = spec_of(command="joint_position")
    assert spec.command is Quantity.JOINT_POSITION
    assert spec.joint_command.name == "joint_position_command"
    np.testing.assert_array_equal(spec.joint_command.bounds, [[-np.inf, -2.6], [np.inf, 2.6]])
    assert spec.joint_command.unit == "rad"


def test_a_command_beyond_the_limit_of_a_joint_names_the_joint():
    spec_of(command_limit=[2.5, 2.5])
    with pytest.raises(UserError) as caught:
        spec_of(command_limit=[2.0, 2.6])
    assert str(caught.value) == (
        "robot 'planar_arm': command_limit: 2.6 rad/s is beyond the limit of 'joint2', 2.5 rad/s"
    )


@pytest.mark.parametrize("values", [[], [2.0, 2.0, 2.0]])
def test_a_command_limit_is_needed_for_each_joint_or_one_for_all(values):
    with pytest.raises(UserError, match=f"command_limit has {len(values)} values for 2 joints"):
        spec_of(command_limit=values)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("env.robot.command=joint_torque", ["env.robot.command", "'joint_velocity' or 'joint_position'"]),
        ("env.robot.command_limit=[0.0,1.0]", ["command_limit.0", "greater than 0"]),
        ("env.robot.command_limit=fast", ["command_limit", "list"]),
        ("env.robot.position_gain=-1.0", ["position_gain", "greater than 0"]),
        ("env.robot.gravity=[0.0,-9.81]", ["gravity", "at least 3 items"]),
    ],
)
def test_an_impossible_value_is_refused_in_one_line(override, words):
    with pytest.raises(UserError) as caught:
        RobotSpec.from_config(validate(EnvConfig, compose("train", [override]).env).robot)
    assert len(str(caught.value).splitlines()) == 1
    for word in words:
        assert word.removeprefix("env.") in str(caught.value)


def test_one_number_stands_for_all_joints():
    spec = spec_of(command_limit=1.5, damping=0.2, friction=[0.1, 0.3])
    assert (spec.command_limit.tolist(), spec.damping.tolist(), spec.friction.tolist()) == (
        [1.5, 1.5],
        [0.2, 0.2],
        [0.1, 0.3],
    )
