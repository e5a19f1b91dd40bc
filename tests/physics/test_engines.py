"""What all engines have in common: each robot for itself, put anywhere, saved and restored bit for bit."""

import numpy as np
import pytest
import torch

from physai.physics import RobotState, nominal_dynamics
from physai.robots import ForwardKinematics, RobotSpec
from tests.physics.moving import commands, dynamics, joints, one_of, reset_all, run, start, weak, wild


@pytest.mark.slow
def test_a_robot_among_64_follows_what_it_follows_alone(spec, make):
    random = np.random.default_rng(0)
    begin = start(spec, 64, random)
    kinds = dynamics(spec, 64), weak(spec, 64), wild(spec, 64, random)
    kind = np.arange(64) * len(kinds) // 64  # a third of the robots each
    parameters = {key: np.choose(kind[:, None], [each[key] for each in kinds]) for key in kinds[0]}
    velocity_commands = commands(spec, 100, 64, random)
    crowd = make(spec, 64)
    reset_all(crowd, begin, parameters)
    together = run(crowd, velocity_commands)
    for row in (0, 15, 16, 31, 32, 63):
        alone = make(spec, 1)
        one = slice(row, row + 1)
        reset_all(alone, one_of(begin, one), {key: value[one] for key, value in parameters.items()})
        np.testing.assert_allclose(run(alone, velocity_commands[:, one]), together[:, :, one], rtol=0, atol=1e-6)
    assert np.ptp(together[-1, 0], axis=0).min() > 0.5  # robots did go different ways


@pytest.mark.slow
def test_a_reset_robot_behaves_exactly_like_a_fresh_one_after_heavy_use(spec, make):
    random = np.random.default_rng(1)
    used, fresh = make(spec, 36), make(spec, 36)
    for _ in range(5):
        some = random.permutation(36)[:7]
        used.reset(some, start(spec, 7, random), wild(spec, 7, random))
        run(used, commands(spec, 30, 36, random))
    rows = np.array([2, 15, 35])
    begin = start(spec, 3, random)
    for physics in (used, fresh):
        physics.reset(rows, begin, weak(spec, 3))
    velocity_commands = commands(spec, 50, 36, random)
    np.testing.assert_array_equal(run(used, velocity_commands)[:, :, rows], run(fresh, velocity_commands)[:, :, rows])


def test_nominal_parameters_after_others_give_back_the_robot_as_made(spec, make):
    random = np.random.default_rng(2)
    used, fresh = make(spec, 3), make(spec, 3)
    reset_all(used, start(spec, 3, random), wild(spec, 3, random))
    run(used, commands(spec, 50, 3, random))
    begin = start(spec, 3, random)
    reset_all(used, begin, dynamics(spec, 3))
    reset_all(fresh, begin)
    velocity_commands = commands(spec, 100, 3, random)
    np.testing.assert_array_equal(run(used, velocity_commands), run(fresh, velocity_commands))


@pytest.mark.slow
def test_resetting_some_robots_leaves_the_others_bit_identical(spec, make):
    random = np.random.default_rng(3)
    begin = start(spec, 36, random)
    parameters = wild(spec, 36, random)
    disturbed, quiet = make(spec, 36), make(spec, 36)
    for physics in (disturbed, quiet):
        reset_all(physics, begin, parameters)
    kept = np.array([0, 3, 4, 16, 33])
    others = np.setdiff1d(np.arange(36), kept)
    for step, command in enumerate(commands(spec, 75, 36, random)):
        if step % 7 == 0:
            some = random.permutation(others)[:4]
            before = joints(disturbed.robot_state())[:, kept]
            disturbed.reset(some, start(spec, 4, random), wild(spec, 4, random))
            np.testing.assert_array_equal(joints(disturbed.robot_state())[:, kept], before)
        a, b = joints(disturbed.step(command)), joints(quiet.step(command))
        np.testing.assert_array_equal(a[:, kept], b[:, kept])
    assert not np.array_equal(a[:, others], b[:, others])
    for key, value in disturbed.parameters().items():
        np.testing.assert_array_equal(value[kept], quiet.parameters()[key][kept])


@pytest.mark.slow
def test_a_restored_state_continues_bit_for_bit_in_a_fresh_instance(spec, make):
    random = np.random.default_rng(0)
    original = make(spec, 34)
    reset_all(original, start(spec, 34, random), wild(spec, 34, random))
    run(original, commands(spec, 50, 34, random))
    original.reset(np.array([1, 33]), start(spec, 2, random), weak(spec, 2))
    run(original, commands(spec, 33, 34, random))
    restored = make(spec, 34)
    run(restored, commands(spec, 5, 34, random))
    restored.set_state(original.state())
    np.testing.assert_array_equal(joints(restored.robot_state()), joints(original.robot_state()))
    velocity_commands = commands(spec, 75, 34, random)
    np.testing.assert_array_equal(run(restored, velocity_commands), run(original, velocity_commands))
    for key, value in restored.parameters().items():
        np.testing.assert_array_equal(value, original.parameters()[key])


def test_a_state_that_was_taken_does_not_change_with_what_happens_later(planar, make):
    random = np.random.default_rng(4)
    physics = make(planar, 4)
    reset_all(physics, start(planar, 4, random), wild(planar, 4, random))
    taken = physics.state()
    copy = {key: value.copy() for key, value in taken.items()}
    run(physics, commands(planar, 20, 4, random))
    physics.reset(np.array([0, 2]), start(planar, 2, random), wild(planar, 2, random))
    for key, value in copy.items():
        np.testing.assert_array_equal(taken[key], value, err_msg=key)


def test_returned_arrays_are_copies(planar, make):
    physics = make(planar, 2)
    after = physics.step(np.ones((2, 2)))
    expected = joints(after)
    after.joint_position[:] += 1
    after.joint_velocity[:] += 1
    physics.robot_state().joint_position[:] = 7
    physics.parameters()["effort_limit"][:] = 0
    np.testing.assert_array_equal(joints(physics.robot_state()), expected)
    assert (physics.parameters()["effort_limit"] > 0).all()


def test_parameters_read_back_from_the_engine_are_those_that_were_set(spec, make):
    random = np.random.default_rng(5)
    physics = make(spec, 20)
    nominal = nominal_dynamics(spec)
    for key, value in physics.parameters().items():
        np.testing.assert_allclose(value, np.repeat(nominal[key], 20, axis=0), rtol=1e-9, atol=1e-12, err_msg=key)
    rows = np.array([0, 5, 19])
    begin = start(spec, 3, random)
    wanted = wild(spec, 3, random)
    wanted["joint_damping"] = random.uniform(0.1, 2.0, wanted["joint_damping"].shape)
    wanted["armature"] = random.uniform(0.0, 0.1, wanted["armature"].shape)
    physics.reset(rows, begin, wanted)
    run(physics, commands(spec, 5, 20, random))
    read = physics.parameters()
    for key, value in wanted.items():
        np.testing.assert_allclose(read[key][rows], value, rtol=1e-9, atol=1e-12, err_msg=key)
        others = np.delete(read[key], rows, axis=0)
        np.testing.assert_allclose(others, np.repeat(nominal[key], 17, axis=0), rtol=1e-9, atol=1e-12, err_msg=key)


@pytest.mark.parametrize("shape", [(3, 2), (4, 3), (8, 1), (2,)])
def test_commands_of_another_shape_are_refused(planar, make, shape):
    physics = make(planar, 4)
    with pytest.raises(ValueError, match="shape"):
        physics.step(np.zeros(shape))


def test_an_arm_without_effort_falls_the_other_way_where_it_hangs_from_a_ceiling(env_config, make):
    config = env_config("panda_reach").robot
    moved = []
    for down in (-9.81, 0.0, 9.81):
        spec = RobotSpec.from_config(config.model_copy(update={"gravity": [0.0, 0.0, down]}))
        physics, none = make(spec, 1), np.zeros((1, 7))
        reset_all(physics, RobotState(spec.home[None], none), nominal_dynamics(spec) | {"effort_limit": none + 1e-3})
        moved.append(run(physics, np.zeros((3, 1, 7)))[-1, 0, 0] - spec.home)
    stands, floats, hangs = np.array(moved)
    height = ForwardKinematics(spec)(torch.from_numpy(spec.home + np.array([stands, hangs])).float())[:, 2]
    assert height[0] < height[1] - 0.005  # m
    np.testing.assert_allclose(floats, 0.0, atol=1e-6)
    np.testing.assert_allclose(hangs, -stands, atol=0.05 * np.abs(stands).max())


@pytest.mark.parametrize("creeping", [1e-11, 1e-5], ids=["as rounding leaves it", "as no encoder sees it"])
def test_a_joint_that_creeps_starts_as_one_that_stands(spec, make, creeping):
    """Friction helps a motor that brakes, and not one that starts; which way the joint creeps, nobody sees."""
    physics, n = make(spec, 3), len(spec.joints)
    velocity = creeping * np.array([[0.0], [-1.0], [1.0]]) + np.zeros((3, n))
    parameters = {key: np.repeat(value, 3, axis=0) for key, value in nominal_dynamics(spec).items()}
    parameters |= {"effort_limit": 0.05 * parameters["effort_limit"]}
    parameters |= {"joint_friction": 0.5 * parameters["effort_limit"]}
    reset_all(physics, RobotState(np.tile(spec.home, (3, 1)), velocity), parameters)
    moved = run(physics, np.broadcast_to(spec.velocity_limit, (5, 3, n)))[-1, 0]
    np.testing.assert_allclose(moved[1:], np.tile(moved[0], (2, 1)), rtol=0, atol=1e-7 + 10.0 * creeping)
    assert np.abs(moved[0] - spec.home).max() > 1e-3
