"""The virtual robot's controller and arm, without ROS."""

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physai.errors import UserError
from physai.ros.virtual.arm import GroupController, VirtualArm
from physai.signals import Quantity


def make(joints, timeout=0.0):
    return GroupController(np.zeros(joints), Quantity.JOINT_VELOCITY, timeout)


WILD = st.floats() | st.just(math.nan)


def test_the_last_velocity_holds_for_ever():
    controller = make(2)
    assert controller.value(0.0).tolist() == [0.0, 0.0]
    controller.command([0.1, -0.2], 1.0)
    assert controller.value(1e9).tolist() == [0.1, -0.2]


def test_with_a_timeout_it_ends_until_the_next_command():
    controller = make(1, timeout=0.5)
    controller.command([0.1], 1.0)
    assert controller.value(1.5).tolist() == [0.1]
    assert controller.value(1.51).tolist() == [0.0]
    controller.command([0.2], 2.0)
    assert controller.value(2.1).tolist() == [0.2]
    controller.timeout = 0.0
    assert controller.value(1e9).tolist() == [0.2]


def test_a_dropped_command_does_not_prolong_the_last():
    controller = make(1, timeout=0.5)
    controller.command([0.1], 1.0)
    controller.command([math.nan], 1.4)
    assert controller.value(1.6).tolist() == [0.0]


@given(st.lists(st.lists(WILD, max_size=4), max_size=20))
def test_it_does_what_the_real_one_does_with_every_sequence_of_commands(commands):
    controller = make(2)
    expected, active = [0.0, 0.0], True
    for now, command in enumerate(commands):
        controller.command(command, float(now))
        if active and len(command) != 2:
            expected, active = [0.0, 0.0], False
        elif active and all(map(math.isfinite, command)):
            expected = command
        assert controller.value(float(now)).tolist() == expected
        assert controller.active == active
    controller.activate()
    assert controller.value(0.0).tolist() == [0.0, 0.0]
    controller.command([1.0, 2.0], 0.0)
    assert controller.value(0.0).tolist() == [1.0, 2.0]


def test_a_controller_of_positions_stays_where_it_was_sent_to_whatever_happens():
    controller = GroupController(np.array([0.5, 0.5]), Quantity.JOINT_POSITION, timeout=0.5)
    assert controller.value(0.0).tolist() == [0.5, 0.5]
    controller.command([0.1, 0.2], 1.0)
    assert controller.value(9.0).tolist() == [0.1, 0.2]
    controller.command([0.1], 9.0)
    assert not controller.active
    assert controller.value(9.0).tolist() == [0.1, 0.2]


def test_an_arm_that_takes_positions_goes_where_it_is_told_and_starts_at_home():
    arm = VirtualArm("reacher", "none", 0, 0.01, ["env.robot.command=joint_position"])
    try:
        assert arm.rest.tolist() == [0.0, 0.0]
        for _ in range(100):
            position, _ = arm.step(np.array([0.3, -0.2]))
        np.testing.assert_allclose(position, [0.3, -0.2], atol=2e-3)
    finally:
        arm.close()


def test_a_command_is_copied():
    controller, command = make(1), np.array([0.1])
    controller.command(command, 0.0)
    command[:] = 5.0
    assert controller.value(0.0).tolist() == [0.1]


def path(randomization: str, seed: int) -> np.ndarray:
    arm = VirtualArm("reacher", randomization, seed, 0.01)
    try:
        return np.array([arm.step(np.array([0.5, -0.3]))[0] for _ in range(50)])
    finally:
        arm.close()


def test_the_ideal_arm_moves_as_told_from_home():
    steps = path("none", 0)
    # It accelerates for a moment.
    assert np.allclose(steps[-1] - steps[-11], [0.05, -0.03], atol=2e-3)
    np.testing.assert_array_equal(steps, path("none", 1))  # there is nothing to draw


def test_randomization_makes_other_arms_the_same_for_the_same_seed():
    one, ideal = path("strong", 0), path("none", 0)
    np.testing.assert_array_equal(one, path("strong", 0))
    assert np.abs(one - ideal).max() > 1e-3
    assert np.abs(one - path("strong", 1)).max() > 1e-3


def test_reset_brings_it_home():
    arm = VirtualArm("reacher", "none", 0, 0.01)
    try:
        home, _ = arm.step(np.zeros(2))
        for _ in range(20):
            arm.step(np.ones(2))
        arm.reset()
        position, velocity = arm.step(np.zeros(2))
        np.testing.assert_allclose(position, home, atol=1e-9)
        np.testing.assert_allclose(velocity, 0.0, atol=1e-9)
    finally:
        arm.close()


@pytest.mark.parametrize(("motor", "tolerance"), [("impulse", 2e-3), ("servo", 5e-3)])  # friction slows a servo down
def test_an_arm_in_another_engine_moves_as_told(motor, tolerance):
    arm = VirtualArm("reacher", "none", 0, 0.01, [f"physics.motor={motor}"], "mujoco")
    try:
        steps = np.array([arm.step(np.array([0.5, -0.3]))[0] for _ in range(50)])
        np.testing.assert_allclose(steps[-1] - steps[-11], [0.05, -0.03], rtol=0, atol=tolerance)
    finally:
        arm.close()


@pytest.mark.parametrize(
    ("env", "randomization", "physics"),
    [("nobody", "none", "pybullet"), ("reacher", "nothing", "pybullet"), ("reacher", "none", "no_engine")],
)
def test_an_unknown_config_is_named(env, randomization, physics):
    with pytest.raises(UserError, match=r"nobody|nothing|no_engine"):
        VirtualArm(env, randomization, 0, 0.01, physics=physics)


def test_an_arm_is_not_simulated_by_a_robot_behind_ros():
    with pytest.raises(UserError, match="physics: 'ros' is no engine that could simulate a robot"):
        VirtualArm("reacher", "none", 0, 0.01, physics="ros")


def test_a_velocity_gain_is_the_same_time_constant_at_any_rate():
    """An arm that is stepped more often than its env lags as far behind."""
    values = {"velocity_gain": 0.5, "joint_damping": 0.0, "joint_friction": 0.0}
    draws = [
        f"randomization.{name}={{distribution:uniform,low:{value},high:{value},operation:set}}"
        for name, value in values.items()
    ]
    away = []
    for period in (0.02, 0.005):
        with contextlib.closing(VirtualArm("reacher", "none", 0, period, draws, "mujoco")) as arm:
            for _ in range(round(0.4 / period)):
                position, velocity = arm.step(np.array([0.5, 0.0]))
            away.append(0.5 * 0.4 - (position - arm.spec.home)[0])
            assert velocity[0] == pytest.approx(0.5, abs=5e-3)
    np.testing.assert_allclose(away, 0.5 * 0.02, rtol=0.3)
