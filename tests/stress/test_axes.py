"""Axes: what they are, which values they go through, and what is refused."""

import numpy as np
import pytest
import torch

from physai.compose import compose
from physai.config import validate
from physai.errors import UserError
from physai.physics import ParameterLayout, RandomizationConfig
from physai.robots import RobotSpec
from physai.stress.__main__ import StressConfig
from physai.stress.axes import Axis
from tests.composed import randomization


def settings(*overrides):
    return validate(StressConfig, compose("stress", ["run=run", *overrides]))


@pytest.fixture
def axis(reacher):
    return lambda name, *overrides: Axis.make(name, settings(*overrides).axes, reacher)


OF_FLOOR = {"floor_friction", "contact_time"}
OF_LEGS = OF_FLOOR | {"stiffness", "servo_damping", "center_of_mass", "push", "gyro_noise", "gravity_noise"}


def test_scales_are_even_in_their_logarithm_and_others_as_they_are(axis):
    np.testing.assert_allclose(axis("link_mass").values(5), [0.2, 0.2 * 5**0.5, 1.0, 5**0.5, 5.0])
    np.testing.assert_allclose(axis("payload").values(5), [0.0, 0.5, 1.0, 1.5, 2.0])


def test_delays_are_whole_control_steps_each_once(axis):
    delay = axis("actuator_delay", "axes.actuator_delay.range=[0,3]")
    assert delay.values(8).tolist() == [0, 1, 2, 3]
    assert delay.between(0, 1) == 0
    assert delay.between(0, 3) == 1


def test_every_axis_of_the_config_can_be_made_and_every_parameter_that_is_drawn_is_one(env_config):
    config = env_config("reacher", "physics=mujoco", "physics.motor=servo")
    legged = env_config("a1_walk", "physics=mujoco")
    axes = settings().axes
    made = [Axis.make(name, axes, legged if name in OF_LEGS else config).name for name in axes]
    assert made == list(axes)
    assert set(RandomizationConfig.model_fields) - {"name"} <= set(axes)


@pytest.mark.parametrize(
    ("name", "overrides", "said"),
    [
        ("link_mas", [], "there is no axis 'link_mas'; did you mean 'link_mass'?"),
        ("motor_time_constant", [], "the axis 'motor_time_constant' needs physics=mujoco physics.motor=servo"),
        ("link_mass", ["axes.link_mass.range=[0,2]"], "axes.link_mass.range: a scale must be above zero"),
        ("link_mass", ["axes.link_mass.range=[2,3]"], "axes.link_mass.range: 1, the robot as described, must be"),
        ("actuator_delay", ["axes.actuator_delay.range=[0,1.5]"], "axes.actuator_delay.range: whole control steps"),
        ("contact_time", [], "the axis 'contact_time' is not one of robot 'planar_arm', which has no such parameter"),
        ("push", [], "the axis 'push' is not one of robot 'planar_arm', which has no such parameter"),
        ("link_mass", ["axes.link_mass.range=[2,0.5]"], "axes.link_mass.range: the first of [2.0, 0.5] must be below"),
        ("payload", ["axes.payload.range=[-1,1]"], "axes.payload.range: the first of [-1.0, 1.0] must be below the"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(axis, name, overrides, said):
    with pytest.raises(UserError) as error:
        axis(name, *overrides)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_what_the_engine_cannot_change_is_no_axis(env_config):
    legged, axes = env_config("a1_walk"), settings().axes
    with pytest.raises(UserError, match="the axis 'contact_time' needs another engine: PyBulletPhysics cannot change"):
        Axis.make("contact_time", axes, legged)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(RandomizationConfig.model_fields) - {"name"}))
def test_a_value_reaches_every_robot_and_leaves_the_other_draws_as_they_are(reacher, env_config, name):
    env = env_config("a1_walk", "physics=mujoco") if name in OF_LEGS else reacher
    env = env_config("reacher", "physics=mujoco") if name == "armature" else env
    layout = ParameterLayout(RobotSpec.from_config(env.robot))
    config = randomization("default")
    drawn = Axis.make(name, settings().axes, env)
    value = drawn.values(3)[1]
    changed = config.model_copy(update={name: drawn.draw(value)})
    first, second = (one.sample(20, layout, torch.Generator().manual_seed(1)) for one in (config, changed))
    columns = torch.zeros(first.shape[1], dtype=torch.bool)
    columns[layout.columns[name]] = True
    assert torch.equal(first[:, ~columns], second[:, ~columns])
    nominal = layout.nominal[columns]
    expected = nominal * value if drawn.operation == "scale" else torch.full_like(nominal, value)  # to zeros is added
    torch.testing.assert_close(second[:, columns], expected.expand(20, -1))


def test_the_range_of_the_training_is_that_of_its_randomization(axis, reacher):
    config = randomization("strong")
    assert axis("link_mass").trained(config, reacher) == (0.5, 2.0)
    assert axis("encoder_offset").trained(config, reacher) == (0.0, 0.02)
    assert axis("link_mass").trained(RandomizationConfig.none(), reacher) == (1.0, 1.0)
    assert axis("tolerance").trained(config, reacher) == (1.0, 1.0)


def test_speed_and_time_constant_change_the_env(axis, reacher, env_config):
    assert axis("speed").change(reacher, 0.5).robot.command_limit == [1.0, 1.0]
    config = env_config("reacher", "physics=mujoco", "physics.motor=servo")
    lag = Axis.make("motor_time_constant", settings().axes, config)
    assert lag.change(config, 0.1).physics["motor_time_constant"] == 0.1
    assert lag.nominal(config) == 0.015
