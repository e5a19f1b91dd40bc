"""PyBullet's motors and limits, solved: what the impulses of any number of joints must be like."""

import numpy as np
import pytest

from physai.physics.impulse import limit_velocity, motor_effort, motor_velocity


def problem(random, robots, joints):
    half = random.normal(size=(robots, joints, joints))
    mass = half @ half.transpose(0, 2, 1) + 0.1 * np.eye(joints)
    free, target = random.normal(size=(2, robots, joints))
    return mass, free, target


@pytest.mark.parametrize("joints", [1, 2, 7])
def test_a_joint_reaches_its_target_or_its_motor_gives_all_that_it_has(joints):
    random = np.random.default_rng(joints)
    mass, free, target = problem(random, 200, joints)
    limit = random.uniform(0.1, 5, target.shape)
    none = np.full_like(target, np.inf)
    velocity = motor_velocity(mass, free, target, limit, -none, none)[0]
    impulse = np.einsum("nij,nj->ni", mass, velocity - free)
    assert (np.abs(impulse) <= limit * (1 + 1e-9)).all()
    missing = target - velocity
    at_limit = np.abs(impulse) > limit * (1 - 1e-9)
    slow = np.abs(missing) > 1e-8
    assert 0.1 < at_limit.mean() < 0.95
    assert (at_limit | ~slow).all()
    assert (np.sign(missing) == np.sign(impulse))[slow].all()


def test_a_limit_holds_against_any_motor_and_only_pushes_away_from_itself():
    mass = np.array([[[2.0, 0.5], [0.5, 1.0]]] * 3)
    free, strong = np.zeros((3, 2)), np.full((3, 2), 9.0)
    target = np.array([[1.0, -2.0], [1.0, 2.0], [1.0, -2.0]])
    lower, upper = np.full((3, 2), -np.inf), np.full((3, 2), np.inf)
    lower[:2, 1] = 0.3
    velocity = motor_velocity(mass, free, target, strong, lower, upper)[0]
    np.testing.assert_allclose(velocity, [[1.0, 0.3], [1.0, 2.0], [1.0, -2.0]], atol=1e-9)
    weak = motor_velocity(mass, np.full((3, 2), -5.0), target, np.full((3, 2), 0.1), lower, upper)[0]
    np.testing.assert_allclose(weak[:2, 1], 0.3, atol=1e-9)
    assert (weak[2] < -4).all()


def test_friction_adds_to_a_motor_for_as_much_of_a_step_as_it_brakes():
    velocity = np.array([[2.0, 0.5, 0.25, 1e-9, 0.0, -2.0, 2.0]])
    command = np.array([[-1.0, -1.0, -1.0, -1.0, -1.0, -3.0, 0.5]])
    found = motor_effort(np.full((1, 7), 3.0), np.full((1, 7), 1.0), command, velocity, 0.02)
    np.testing.assert_allclose(found, [[4.0, 4.0, 3.0, 2.0, 2.0, 2.0, 4.0]], atol=1e-6)


def test_what_rounding_leaves_of_a_missing_velocity_changes_no_effort():
    velocity = np.full((1, 3), 2.0)
    command = velocity + np.array([[-1e-12, 0.0, 1e-12]])
    found = motor_effort(np.full((1, 3), 3.0), np.full((1, 3), 1.0), command, velocity, 0.02)
    np.testing.assert_allclose(found, 2.0, atol=1e-9)


def test_a_motor_that_is_too_weak_for_the_friction_gives_nothing():
    one = np.ones((1, 1))
    assert motor_effort(one, 1.5 * one, one, 0.0 * one, 0.02) == 0.0


def test_a_limit_is_where_a_joint_is_pushed_back():
    found = limit_velocity(np.array([-0.1, 0.0, 0.02, 0.05]), 0.02)
    np.testing.assert_allclose(found, [-np.inf, 0.0, 0.2, 0.0])


@pytest.mark.parametrize("joints", [2, 7, 9])
def test_a_robot_among_others_gets_the_same_bits_as_alone(joints):
    random = np.random.default_rng(0)
    mass, free, target = problem(random, 100, joints)
    limit, none = random.uniform(0.1, 5, target.shape), np.full_like(target, np.inf)
    together = motor_velocity(mass, free, target, limit, -none, none)[0]
    for row in range(0, 100, 7):
        one = slice(row, row + 1)
        alone = motor_velocity(mass[one], free[one], target[one], limit[one], -none[one], none[one])[0]
        np.testing.assert_array_equal(alone, together[one])
