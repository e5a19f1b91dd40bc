"""A randomization that changes nothing, or is another robot's, is found out.

What is drawn: tests/transforms/test_randomization.py.
"""

import pytest
import torch

from physai.config import validate
from physai.errors import UserError
from physai.physics import ParameterLayout, RandomizationConfig
from physai.robots import RobotSpec
from tests.composed import composed


@pytest.fixture(scope="module")
def layout(planar):
    return ParameterLayout(planar)


@pytest.fixture(scope="module")
def kuka(kuka_reacher):
    return ParameterLayout(RobotSpec.from_config(kuka_reacher.robot))


def config(*overrides):
    return validate(RandomizationConfig, composed(*overrides).randomization)


def drawn(name, operation):
    return config(
        "randomization=none", f"randomization.{name}={{distribution:uniform,low:0.5,high:2.0,operation:{operation}}}"
    )


def test_a_scale_of_what_the_robot_s_description_leaves_at_zero_is_named(kuka):
    assert not kuka.nominal[kuka.columns["joint_friction"]].any()
    assert drawn("joint_friction", "scale").without_effect(kuka).keys() == {"joint_friction"}
    assert "joint_friction" in config("randomization=default").without_effect(kuka)


@pytest.mark.parametrize("operation", ["add", "set"])
def test_what_is_added_or_set_has_an_effect_on_zero(kuka, operation):
    assert drawn("joint_friction", operation).without_effect(kuka) == {}


@pytest.mark.parametrize("randomization", ["none", "default", "strong"])
def test_all_that_is_drawn_for_the_planar_arm_has_an_effect(planar, reacher, randomization):
    layout = ParameterLayout(planar, reacher.ignored)
    assert layout.ignored
    assert config(f"randomization={randomization}").without_effect(layout) == {}


@pytest.mark.parametrize("name", ["payload", "actuator_delay", "encoder_offset", "position_noise", "velocity_noise"])
def test_what_is_zero_on_every_robot_cannot_be_scaled(layout, name):
    assert drawn(name, "scale").without_effect(layout).keys() == {name}


def test_what_an_engine_cannot_change_is_not_drawn_and_named(env_config):
    env = env_config("a1_walk")
    layout = ParameterLayout(RobotSpec.from_config(env.robot), env.ignored)
    default = config("randomization=default")
    assert default.without_effect(layout)["center_of_mass"] == "this engine cannot change it"
    sampled = default.sample(8, layout, torch.Generator().manual_seed(0))
    assert not sampled[:, layout.columns["center_of_mass"]].any()


def test_a_scale_counts_when_a_single_joint_has_something_to_scale(planar):
    half = ParameterLayout(planar)
    half.nominal[half.columns["joint_damping"]] *= half.nominal.new_tensor([0.0, 1.0])
    assert drawn("joint_damping", "scale").without_effect(half) == {}


def of_columns(low, high):
    return config(
        "randomization=none", f"randomization.link_mass={{distribution:uniform,low:{low},high:{high},operation:set}}"
    )


def test_each_column_may_have_a_range_of_its_own(layout):
    draws = of_columns([1.0, 2.0, 0.1], [1.5, 2.0, 0.2])
    draws.check(layout)
    mass = draws.sample(500, layout, torch.Generator().manual_seed(0))[:, layout.columns["link_mass"]]
    low, high = mass.min(dim=0).values, mass.max(dim=0).values
    torch.testing.assert_close(low, torch.tensor([1.0, 2.0, 0.1]), rtol=0, atol=5e-3)
    torch.testing.assert_close(high, torch.tensor([1.5, 2.0, 0.2]), rtol=0, atol=5e-3)


def test_ranges_of_a_robot_with_other_links_are_refused(layout):
    with pytest.raises(UserError, match=r"link_mass: 2 values, and there are link_mass\[link1\], link_mass\[link2\], "):
        of_columns([1.0, 2.0], [1.0, 2.0]).check(layout)


@pytest.mark.parametrize(
    ("low", "high", "line"),
    [
        ([1.0, 2.0, 0.1], [1.0, 1.9, 0.1], "is above"),
        ([1.0, 2.0], [1.0, 2.0, 3.0], "as many values"),
        (1.0, [1.0, 2.0, 3.0], "as many values"),
    ],
)
def test_ranges_that_are_none_are_refused(low, high, line):
    with pytest.raises(UserError, match=line):
        of_columns(low, high)
