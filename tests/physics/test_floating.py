"""Robots whose base nothing holds, in each engine: they fall, stand, touch the floor, and are put anywhere."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from physai.errors import UserError
from physai.physics import RobotState, nominal_dynamics
from physai.physics.interface import at_home
from physai.physics.mujoco import MuJoCoPhysics
from physai.physics.pybullet import PyBulletPhysics
from physai.robots import RobotConfig, RobotSpec
from tests.physics.conftest import MOTOR

ENGINES = {"pybullet": PyBulletPhysics, "mujoco": partial(MuJoCoPhysics, motor="impulse", **MOTOR)}
DT = 0.02
SUBSTEPS = 4


@pytest.fixture(scope="module")
def legged(any_legged):
    return RobotSpec.from_config(any_legged.robot)


@pytest.fixture(params=ENGINES)
def make(request):
    made = []

    def make_physics(spec, robots):
        made.append(ENGINES[request.param](spec, robots, DT, SUBSTEPS))
        return made[-1]

    yield make_physics
    for physics in made:
        physics.close()


def stand(physics, spec, seconds):
    for _ in range(round(seconds / DT)):
        state = physics.step(np.tile(spec.home, (physics.num_robots, 1)))
    return state


def lifted(spec, robots, by):
    state = at_home(spec, robots)
    state.base_pose[:, 2] += by
    return state


def test_a_dropped_robot_stands_on_its_feet_and_on_nothing_else(legged, make):
    physics = make(legged, 2)
    physics.reset(np.arange(2), lifted(legged, 2, by=0.1))
    assert not physics.robot_state().contact.any()
    state = stand(physics, legged, 2.0)
    feet = np.isin(np.arange(len(legged.floating.links)), legged.floating.feet)
    assert (state.contact == feet).all()
    assert np.abs(state.base_pose[:, 2] - legged.floating.height).max() < 0.15 * legged.floating.height
    assert state.base_pose[:, 6].min() > 0.99  # upright
    assert np.abs(state.base_twist).max() < 0.1
    weight = 9.81 * legged.link_mass.sum()
    assert 0.3 * weight * 0.05 < np.abs(state.joint_effort).sum(axis=1).min() < legged.effort_limit.sum()


def test_legs_that_are_light_and_damped_come_to_rest_in_the_air(legged, make):
    physics, robots = make(legged, 2), np.arange(2)
    parameters = {key: value.repeat(2, axis=0) for key, value in nominal_dynamics(legged).items()}
    parameters["link_mass"] *= 0.8
    parameters["servo_damping"] *= 1.2
    state = lifted(legged, 2, by=50.0)
    state.joint_position[:] += 0.1
    physics.reset(robots, state, parameters)
    speeds = [np.abs(stand(physics, legged, DT).joint_velocity).max() for _ in range(25)]
    assert max(speeds) < 20.0
    assert speeds[-1] < 0.05


def test_engines_agree_on_how_a_base_falls_and_turns(legged, make):
    state = lifted(legged, 1, by=5.0)
    half = np.sin(0.3)
    state.base_pose[:, 3:] = [0.0, half, 0.0, np.cos(0.3)]
    state.base_twist[:] = [1.0, -0.5, 0.2, 0.3, 0.2, 0.5]
    physics = make(legged, 1)
    physics.reset(np.array([0]), state)
    told = physics.robot_state()
    np.testing.assert_allclose(told.base_pose, state.base_pose, atol=1e-6)
    np.testing.assert_allclose(told.base_twist, state.base_twist, atol=1e-6)
    moved = stand(physics, legged, 0.2)
    expected = state.base_pose[0, :3] + 0.2 * state.base_twist[0, :3] + [0.0, 0.0, -0.5 * 9.81 * 0.04]
    np.testing.assert_allclose(moved.base_pose[0, :3], expected, atol=0.03)
    np.testing.assert_allclose(moved.base_twist[0, 3:], state.base_twist[0, 3:], atol=0.3)


def test_a_robot_put_on_its_side_touches_the_floor_with_more_than_feet(legged, make):
    state = at_home(legged, 1)
    state.base_pose[:, 3:] = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    physics = make(legged, 1)
    physics.reset(np.array([0]), state)
    touched = np.zeros(len(legged.floating.links), bool)
    for _ in range(50):
        touched |= physics.step(legged.home[None]).contact[0]
    assert touched[[link for link in range(len(touched)) if link not in legged.floating.feet]].any()


def test_less_friction_lets_a_robot_slide_farther(legged, make):
    slid = []
    for friction in (0.1, 1.0):
        physics = make(legged, 1)
        state = at_home(legged, 1)
        state.base_twist[:, 0] = 1.0
        parameters = {**nominal_dynamics(legged), "floor_friction": np.array([[friction]])}
        physics.reset(np.array([0]), state, parameters)
        slid.append(float(stand(physics, legged, 0.6).base_pose[0, 0]))
    assert slid[0] > 1.5 * slid[1]


def test_in_mujoco_feet_sink_into_a_softer_floor(legged):
    times, feet = (0.01, 0.02, 0.04), legged.floating.feet
    physics = ENGINES["mujoco"](legged, len(times), DT, SUBSTEPS)
    parameters = {key: value.repeat(len(times), axis=0) for key, value in nominal_dynamics(legged).items()}
    parameters["contact_time"] = np.array(times)[:, None]
    physics.reset(np.arange(len(times)), at_home(legged, len(times)), parameters)
    state = stand(physics, legged, 2.0)
    assert state.contact[:, feet].all()
    assert (np.diff(state.base_pose[:, 2]) < -2e-4).all()
    np.testing.assert_array_equal(physics.parameters()["contact_time"], parameters["contact_time"])


@pytest.mark.parametrize("in_its_frame", [False, True])
def test_a_base_with_another_centre_of_mass_moves_in_mujoco_as_if_it_were_described_so(legged, in_its_frame):
    def described(com):
        base, *others = legged.bodies
        inertia = np.eye(3) * np.trace(base.inertia) / 3 if in_its_frame else base.inertia
        return replace(legged, bodies=(replace(base, com=com, inertia=inertia), *others))

    com, shift = legged.bodies[0].com * (not in_its_frame), np.array([0.03, -0.02, 0.01])
    given, expected = (ENGINES["mujoco"](described(each), 1, DT, SUBSTEPS) for each in (com, com + shift))
    row, parameters = np.array([0]), nominal_dynamics(legged)
    before = stand(given, legged, 0.4)
    given.reset(row, at_home(legged, 1), {**parameters, "center_of_mass": shift[None]})
    expected.reset(row, at_home(legged, 1), parameters)
    moved, told = stand(given, legged, 0.4), stand(expected, legged, 0.4)
    np.testing.assert_allclose(moved.joint_position, told.joint_position, atol=1e-9)
    np.testing.assert_allclose(moved.base_pose, told.base_pose, atol=1e-9)
    assert np.abs(moved.joint_effort - before.joint_effort).max() > 0.05 * np.abs(before.joint_effort).max()
    np.testing.assert_allclose(given.parameters()["center_of_mass"], shift[None], atol=1e-12)


def test_mujoco_goes_on_from_a_saved_state_bit_for_bit_and_a_reset_robot_is_as_a_fresh_one(legged):
    make = partial(ENGINES["mujoco"], legged, 3, DT, 4)
    random = np.random.default_rng(0)
    given = legged.home + random.uniform(-0.2, 0.2, (40, 3, len(legged.joints)))
    used, other = make(), make()
    for command in given:
        used.step(command)
    other.set_state(used.state())
    for one, two in zip(map(used.step, given), map(other.step, given), strict=True):
        assert same(one, two)
    rows = np.array([0, 2])
    fresh = make()
    for physics in (used, fresh):
        physics.reset(rows, lifted(legged, 2, by=0.02))
    for one, two in zip(map(used.step, given), map(fresh.step, given), strict=True):
        assert same(*(RobotState(*(part[rows] for part in vars(state).values())) for state in (one, two)))


def same(one, two):
    return all(np.array_equal(a, b) for a, b in zip(vars(one).values(), vars(two).values(), strict=True))


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"servo": None}, "a floating base needs joints that are springs: give a servo"),
        ({"floating": None}, "a robot whose base is fixed needs an end_effector"),
        ({"command": "joint_velocity", "action": "speed"}, "a servo needs command: joint_position"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(any_legged, changes, line):
    config = any_legged.robot.model_dump() | changes
    with pytest.raises(UserError, match=line):
        RobotSpec.from_config(RobotConfig.model_validate(config))


def test_a_foot_without_a_sphere_is_refused_with_the_nearest_name(any_legged):
    config = any_legged.robot.model_dump()
    config["floating"]["feet"][0] += "s"
    with pytest.raises(UserError, match=r"floating.feet: '\w+' has no sphere; did you mean"):
        RobotSpec.from_config(RobotConfig.model_validate(config))
