"""Robots that take positions: a servo in front of each joint's motor."""

import dataclasses

import numpy as np
import pytest

from physai.physics import RobotState
from physai.robots import RobotSpec
from physai.signals import Quantity
from tests.physics.moving import DT, dynamics, joints, reset_all, resting, run, weak

TARGET = np.array([[0.8, -0.6], [-1.2, 0.9]])

pytestmark = pytest.mark.parametrize("engine", ["pybullet", "impulse"], indirect=True)


@pytest.fixture(scope="module")
def spec(two_joint_env):
    return dataclasses.replace(RobotSpec.from_config(two_joint_env.robot), command=Quantity.JOINT_POSITION)


@pytest.fixture
def servos(spec, make):
    """Two robots that take positions, at home."""
    physics = make(spec, 2)
    reset_all(physics, resting(2))
    return physics


def held(physics, target, steps=200):
    """Hold a target [N, n]; return positions and velocities [T, N, n]."""
    return np.moveaxis(run(physics, np.repeat(target[None], steps, axis=0)), 1, 0)


def test_joints_reach_their_targets_and_stay_there(servos):
    position, velocity = held(servos, TARGET)
    np.testing.assert_allclose(position[-50:], np.broadcast_to(TARGET, (50, 2, 2)), rtol=0, atol=2e-3)
    np.testing.assert_allclose(velocity[-50:], 0.0, rtol=0, atol=2e-3)


def test_no_joint_moves_faster_than_its_limit_on_the_way(spec, servos):
    _, velocity = held(servos, 10 * TARGET, 50)
    np.testing.assert_allclose(np.abs(velocity).max(axis=(0, 1)), spec.velocity_limit, rtol=0.02)


def test_near_its_target_a_joint_slows_down_as_its_gain_says(spec, servos):
    position, velocity = held(servos, np.full((2, 2), 0.02), 8)
    to_go = 0.02 - np.concatenate([np.zeros((1, 2, 2)), position[:-1]])
    np.testing.assert_allclose(velocity[3:], spec.position_gain * to_go[3:], rtol=0, atol=0.01)


def test_a_joint_that_is_told_where_it_is_stays_there(spec, make):
    physics = make(spec, 2)
    reset_all(physics, RobotState(TARGET, np.zeros((2, 2))))
    position, velocity = held(physics, TARGET, 300)
    np.testing.assert_allclose(position[-1], TARGET, rtol=0, atol=1e-3)
    np.testing.assert_allclose(velocity[-1], 0.0, rtol=0, atol=1e-3)


def test_a_weak_servo_under_gravity_hangs_a_little_below_its_target(kuka_reacher, make):
    kuka = RobotSpec.from_config(kuka_reacher.robot)
    physics = make(dataclasses.replace(kuka, command=Quantity.JOINT_POSITION), 1)
    lying = np.array([[0.0, np.pi / 2]])
    reset_all(physics, RobotState(lying, np.zeros((1, 2))), dynamics(kuka, 1, velocity_gain=0.5))
    position, velocity = held(physics, lying, 300)
    assert 0.001 < position[-1, 0, 1] - lying[0, 1] < 0.05  # joint 2 turns down
    np.testing.assert_allclose(velocity[-1], 0.0, rtol=0, atol=1e-3)


def test_a_restored_state_goes_on_bit_for_bit(spec, make):
    physics, restored = make(spec, 2), make(spec, 2)
    reset_all(physics, resting(2), weak(spec, 2))
    held(physics, TARGET, 10)
    restored.set_state(physics.state())
    np.testing.assert_array_equal(joints(restored.robot_state()), joints(physics.robot_state()))
    np.testing.assert_array_equal(held(restored, -TARGET, 50), held(physics, -TARGET, 50))


@pytest.mark.parametrize("substeps", [1, 4])
def test_a_target_that_moves_is_followed_a_servo_s_time_behind(spec, make, substeps):
    physics = make(spec, 1, substeps=substeps)
    reset_all(physics, resting(1))
    targets = 0.3 * DT * np.arange(1, 101)[:, None, None] * np.ones((1, 1, 2))  # 0.3 rad/s
    behind = targets - run(physics, targets)[:, 0]
    np.testing.assert_allclose(behind[-20:], 0.3 * (1 / spec.position_gain - DT), rtol=0, atol=2e-4)
