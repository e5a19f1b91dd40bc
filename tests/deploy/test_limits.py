import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physai.deploy import ControllerConfig
from physai.deploy.limits import VelocityLimits

PERIOD, EVER = 0.02, 1e3  # s; after EVER the acceleration limit allows everything
STILL, MIDDLE = np.zeros(2), np.array([0.5, 1.0])


@pytest.fixture(scope="module")
def metadata(policy):
    """Of an arm whose first joint has limits, too: positions of 6.2832 and 2.6 rad, commands of 2 rad/s."""
    return dataclasses.replace(policy.metadata, position_limit=np.array([[-6.2832, 6.2832], [-2.6, 2.6]]))


@pytest.fixture(scope="module")
def limits(metadata):
    return VelocityLimits(metadata, ControllerConfig())


def reasoned(limits, wanted, position=MIDDLE, last=STILL, elapsed=EVER):
    return limits.apply(np.array(wanted), np.array(position), np.array(position), np.array(last), elapsed)


def apply(*arguments, **keywords):
    return reasoned(*arguments, **keywords)[0]


def test_a_slow_command_in_the_middle_passes_as_it_is(limits):
    np.testing.assert_array_equal(apply(limits, [0.29, -0.1]), [0.29, -0.1])


def test_the_whole_vector_is_scaled_down_to_max_velocity_and_keeps_its_direction(limits):
    np.testing.assert_allclose(apply(limits, [1.2, -0.4]), [0.3, -0.1])
    np.testing.assert_allclose(apply(limits, [0.4, -2.0]), [0.06, -0.3])


def test_a_command_is_clamped_to_the_policy_s_range_before_it_is_scaled(limits):
    np.testing.assert_allclose(apply(limits, [1e300, 1.0]), [0.3, 0.15])
    np.testing.assert_allclose(apply(limits, [-4.0, 4.0]), [-0.3, 0.3])
    assert not limits.out_of_range(np.array([2.0, -2.0]))
    assert not limits.out_of_range(np.array([np.float32(2.0000002), 0.0]))
    assert limits.out_of_range(np.array([0.0, -2.01]))


@pytest.mark.parametrize("sign", [1, -1])
def test_within_the_margin_no_joint_moves_outward_and_the_others_go_on(limits, sign):
    for position in (2.5, 2.55, 2.6):
        np.testing.assert_array_equal(apply(limits, [0.2, sign * 0.2], [0.0, sign * position]), [0.2, 0.0])
        np.testing.assert_array_equal(apply(limits, [0.2, -sign * 0.2], [0.0, sign * position]), [0.2, -sign * 0.2])
    np.testing.assert_array_equal(apply(limits, [0.2, sign * 0.2], [0.0, sign * 2.499]), [0.2, sign * 0.2])
    np.testing.assert_array_equal(apply(limits, [sign * 0.2, 0.2], [sign * 6.19, 0.0]), [0.0, 0.2])


def test_outward_motion_at_a_limit_stops_at_once_whatever_the_acceleration_limit(limits):
    velocity = apply(limits, [0.3, 0.3], [0.0, 2.5], [0.3, 0.3], PERIOD)
    np.testing.assert_array_equal(velocity, [0.3, 0.0])


def test_a_joint_that_turns_at_a_limit_stops_first(limits):
    velocity = apply(limits, [0.3, -0.3], [0.0, 2.5], [0.0, 0.3], PERIOD)
    np.testing.assert_allclose(velocity, [0.04, 0.0])
    np.testing.assert_allclose(apply(limits, [0.0, -0.3], [0.0, 2.5], STILL, PERIOD), [0.0, -0.04])


@pytest.mark.parametrize("sign", [1, -1])
def test_a_position_limit_that_acts_is_named(limits, sign):
    outward, inward, inside = [0.2, sign * 0.2], [0.2, -sign * 0.2], [0.0, sign * 2.55]
    assert reasoned(limits, [2.0, sign * 2.0], elapsed=PERIOD)[1] is None
    assert reasoned(limits, inward, inside)[1] is None
    assert reasoned(limits, outward, inside)[1] == "a joint is at its position limit: no motion outward"
    for wanted in (outward, inward, STILL):
        assert reasoned(limits, wanted, [0.0, sign * 2.65])[1] == "a joint is beyond its position limit: slow"


def test_a_position_limit_that_stops_a_joint_that_shall_turn_is_named_too(limits):
    assert reasoned(limits, [0.0, -0.3], [0.0, 2.5], [0.0, 0.3], PERIOD)[1] is not None


def test_velocities_change_by_no_more_than_the_acceleration_limit_allows(limits):
    np.testing.assert_allclose(apply(limits, [0.3, 0.0], elapsed=PERIOD), [0.04, 0.0])
    np.testing.assert_allclose(apply(limits, [0.3, 0.15], elapsed=PERIOD), [0.04, 0.02])
    np.testing.assert_allclose(apply(limits, [-0.3, 0.3], last=[0.3, 0.3], elapsed=PERIOD), [0.26, 0.3])
    np.testing.assert_allclose(apply(limits, [0.01, 0.02], last=[0.0, 0.0], elapsed=PERIOD), [0.01, 0.02])
    np.testing.assert_array_equal(apply(limits, [0.3, 0.3], last=[0.1, -0.2], elapsed=0.0), [0.1, -0.2])
    np.testing.assert_array_equal(apply(limits, [0.1, -0.2], last=[0.1, -0.2], elapsed=0.0), [0.1, -0.2])


@pytest.mark.parametrize("sign", [1, -1])
def test_beyond_a_limit_the_arm_moves_slowly_and_only_inward(limits, sign):
    beyond = [0.0, sign * 2.65]
    np.testing.assert_allclose(apply(limits, [0.0, -sign * 2.0], beyond), [0.0, -sign * 0.05])
    np.testing.assert_allclose(apply(limits, [2.0, -sign * 2.0], beyond), [0.05, -sign * 0.05])
    np.testing.assert_allclose(apply(limits, [2.0, sign * 2.0], beyond), [0.05, 0.0])


def test_beyond_a_limit_the_whole_arm_is_slow_at_once_however_fast_it_was(limits):
    for last in ([0.3, 0.0], [0.3, -0.3], [-0.3, 0.3], [0.3, 0.3]):
        velocity = apply(limits, [2.0, -2.0], [0.0, 2.65], last, PERIOD)
        assert np.abs(velocity).max() <= 0.05 + 1e-12
    np.testing.assert_allclose(
        apply(limits, [2.0, -2.0], [0.0, 2.65], [0.3, 0.0], PERIOD), [0.05, -0.05 * 0.008 / 0.26]
    )


def test_slow_is_never_faster_than_max_velocity(metadata):
    slow = VelocityLimits(metadata, ControllerConfig(max_velocity=0.02, limit_velocity=1.0))
    np.testing.assert_allclose(apply(slow, [0.0, -2.0], [0.0, 2.65]), [0.0, -0.02])


def test_farther_beyond_a_limit_than_limit_fault_is_far(limits):
    assert limits.far_beyond(np.array([6.2832, -2.6])) is None
    assert limits.far_beyond(np.array([6.4, 2.79])) is None
    assert limits.far_beyond(np.array([0.0, 2.81])) == 1
    assert limits.far_beyond(np.array([-6.5, 0.0])) == 0


def test_a_continuous_joint_has_no_limits(policy):
    limits = VelocityLimits(policy.metadata, ControllerConfig())
    assert limits.far_beyond(np.array([1e6, 0.0])) is None
    np.testing.assert_array_equal(apply(limits, [0.2, 0.2], [-1e6, 0.0]), [0.2, 0.2])


vectors = st.tuples(*[st.floats(-1e308, 1e308) | st.floats(-3, 3) | st.sampled_from([0.0, 5e-324, 0.3, -0.3])] * 2)
slow_vectors = st.tuples(*[st.floats(-0.3, 0.3)] * 2)
positions = st.tuples(st.floats(-6.5, 6.5), st.floats(-2.8, 2.8))


@given(vectors, positions, slow_vectors, st.sampled_from([0.0, 1e-12, 0.001, PERIOD, EVER]))
def test_whatever_is_wanted_the_limits_hold(limits, wanted, position, last, elapsed):
    velocity = apply(limits, wanted, position, last, elapsed)
    assert np.isfinite(velocity).all()
    assert (np.abs(velocity) <= 0.3 * (1 + 1e-12)).all()
    beyond = abs(position[0]) > 6.2832 or abs(position[1]) > 2.6
    for joint, limit in enumerate((6.2832, 2.6)):
        side = (position[joint] >= limit - 0.1) - (position[joint] <= -limit + 0.1)
        assert velocity[joint] * side <= 0
        if last[joint] * side > 0:
            assert velocity[joint] == 0
        elif beyond:
            assert abs(velocity[joint]) <= 0.05 + 1e-12
        else:
            assert abs(velocity[joint] - last[joint]) <= 2.0 * elapsed + 1e-12
