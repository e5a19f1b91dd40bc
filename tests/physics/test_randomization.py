"""A randomization that changes nothing is found out. (What is drawn: tests/transforms/test_randomization.py.)"""

import pytest

from physai.compose import compose
from physai.config import validate
from physai.physics import ParameterLayout, RandomizationConfig
from physai.robots import RobotSpec


@pytest.fixture(scope="module")
def layout(planar):
    return ParameterLayout(planar)


@pytest.fixture(scope="module")
def kuka(kuka_reacher):
    return ParameterLayout(RobotSpec.from_config(kuka_reacher.robot))


def config(*overrides):
    return validate(RandomizationConfig, compose("train", overrides).randomization)


def drawn(name, operation):
    return config(
        "randomization=none", f"randomization.{name}={{distribution:uniform,low:0.5,high:2.0,operation:{operation}}}"
    )


def test_a_scale_of_what_the_robot_s_description_leaves_at_zero_is_named(kuka):
    assert not kuka.nominal[kuka.columns["joint_friction"]].any()
    assert drawn("joint_friction", "scale").without_effect(kuka) == ["joint_friction"]
    assert "joint_friction" in config("randomization=default").without_effect(kuka)


@pytest.mark.parametrize("operation", ["add", "set"])
def test_what_is_added_or_set_has_an_effect_on_zero(kuka, operation):
    assert drawn("joint_friction", operation).without_effect(kuka) == []


@pytest.mark.parametrize("randomization", ["none", "default", "strong"])
def test_all_that_is_drawn_for_the_planar_arm_has_an_effect(layout, randomization):
    assert config(f"randomization={randomization}").without_effect(layout) == []


@pytest.mark.parametrize("name", ["payload", "actuator_delay", "encoder_offset", "position_noise", "velocity_noise"])
def test_what_is_zero_on_every_robot_cannot_be_scaled(layout, name):
    assert drawn(name, "scale").without_effect(layout) == [name]


def test_a_scale_counts_when_a_single_joint_has_something_to_scale(planar):
    half = ParameterLayout(planar)
    half.nominal[half.columns["joint_damping"]] *= half.nominal.new_tensor([0.0, 1.0])
    assert drawn("joint_damping", "scale").without_effect(half) == []
