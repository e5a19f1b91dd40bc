"""What was found becomes ranges: narrow where the data tell, and as before where they do not."""

import dataclasses

import numpy as np
import pytest
from omegaconf import OmegaConf

from physai.config import validate
from physai.identify.fit import SPREAD
from physai.identify.randomization import FLOOR, identified, text
from physai.physics import RandomizationConfig
from tests.composed import randomization


@pytest.fixture(scope="module")
def base():
    return randomization("default")


def test_what_is_told_is_drawn_from_its_interval_and_never_from_less_than_the_floor(found, layout, base):
    mass = identified(found, layout, base).link_mass
    np.testing.assert_allclose([mass.low[0], mass.high[0]], np.exp([-FLOOR, FLOOR]), rtol=1e-4)
    np.testing.assert_allclose([mass.low[1], mass.high[1]], 2.0 * np.exp([-SPREAD * 0.1, SPREAD * 0.1]), rtol=1e-4)


def test_a_friction_that_is_small_beside_the_effort_is_not_drawn_far_from_what_was_found(found, layout, base):
    found.coordinates[4], found.deviation[4], found.alone[4] = -0.1, 1e-6, 1e-6
    friction, value = identified(found, layout, base).joint_friction, found.values[4]
    assert 0.0 < value < 0.03
    assert [friction.low[0], friction.high[0]] == pytest.approx([0.75 * value, 1.25 * value], rel=1e-4)


def test_parameters_that_only_show_together_are_drawn_close_to_what_was_found(found, layout, base):
    draws = identified(found, layout, base)
    assert draws.link_mass.high[2] < 1.06
    assert draws.payload.high < 0.02


def test_what_does_not_show_and_the_zeros_of_encoders_are_drawn_as_before(found, layout, base):
    draws = identified(found, layout, base)
    nominal = layout.nominal[layout.columns["joint_friction"]][1]
    expected = [float(nominal) * each for each in (base.joint_friction.low, base.joint_friction.high)]
    np.testing.assert_allclose([draws.joint_friction.low[1], draws.joint_friction.high[1]], expected, rtol=1e-5)
    assert draws.encoder_offset == base.encoder_offset


def test_what_was_not_looked_for_stays_as_described(found, layout, base):
    draws = identified(found, layout, base)
    assert draws.effort_limit is None
    assert draws.joint_damping is None


@pytest.mark.parametrize(("delay", "low", "high"), [(1.5, 1.0, 2.0), (2.0, 2.0, 2.0), (0.25, 0.0, 1.0)])
def test_a_delay_between_two_steps_is_now_the_one_now_the_other(found, layout, base, delay, low, high):
    draws = identified(dataclasses.replace(found, delay=delay), layout, base)
    assert (draws.actuator_delay.low, draws.actuator_delay.high) == (low, high)


def test_the_file_says_the_same(found, layout, base):
    draws = identified(found, layout, base)
    written = text(draws, layout, ["of a test"])
    assert validate(RandomizationConfig, OmegaConf.create(written)) == draws
    assert written.startswith("# of a test\n")
    assert "# link_mass[link1], link_mass[link2], link_mass[tool]" in written
