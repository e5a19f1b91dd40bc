"""What each dynamics parameter does to a robot, with PyBullet's motors, and with MuJoCo's that follow their law."""

import numpy as np
import pytest

from physai.robots import RobotSpec
from tests.physics.moving import DT, dynamics, reset_all, resting, run, start

pytestmark = pytest.mark.parametrize("engine", ["pybullet", "impulse"], indirect=True)


def speeds(physics, parameters, steps, qd=0.0, command=1.0):
    """Joint velocities [steps, rows, n] of robots that hold one command from the same pose."""
    shape = physics.robot_state().joint_position.shape
    reset_all(physics, resting(shape[0], velocity=qd, joints=shape[1]), parameters)
    return run(physics, np.full((steps, *shape), command))[:, 1]


def test_a_continuous_joint_turns_without_end(planar, make):
    physics = make(planar, 2)
    reset_all(physics, resting(2))
    there_and_back = np.array([[2.0, 0.0], [-2.0, 0.0]])
    q, qd = run(physics, np.repeat(there_and_back[None], 1000, axis=0))[-1]
    np.testing.assert_allclose(q[:, 0], [40.0, -40.0], rtol=0.01)  # more than six turns
    np.testing.assert_allclose(qd, there_and_back, atol=0.02)


def test_less_effort_speeds_up_more_slowly(planar, make):
    physics = make(planar, 3)
    found = speeds(physics, dynamics(planar, 3, effort_limit=[0.5, 1.0, 5.0], joint_friction=0.0), 3)[0, :, 0]
    assert found[0] < 0.7 * found[1]
    assert found[1] < 0.9 * found[2]


def test_a_lower_velocity_gain_tracks_more_slowly(planar, make):
    physics = make(planar, 3)
    found = speeds(physics, dynamics(planar, 3, velocity_gain=[0.1, 0.3, 1.0], effort_limit=100.0), 1)[0, :, 0]
    assert found[0] < found[1] < found[2]
    assert found[2] == pytest.approx(1.0, abs=0.05)
    assert found[0] < 0.5


def test_friction_slows_speeding_up_and_holds_a_robot_that_is_too_weak_for_it(planar, make):
    physics = make(planar, 3)
    parameters = dynamics(planar, 3, effort_limit=1.0, joint_friction=[0.0, 0.5, 1.2])
    found = speeds(physics, parameters, 8)[-1, :, 0]
    assert found[0] > 1.5 * found[1] > 0.1
    assert found[2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("target", [0.5, 0.0, -0.5], ids=["slow down", "stop", "turn back"])
def test_friction_helps_to_brake(planar, make, target):
    physics = make(planar, 2)
    parameters = dynamics(planar, 2, joint_damping=0.0)
    parameters["effort_limit"] = np.array([[100.0, 0.3]] * 2)  # a strong first joint holds still
    parameters["joint_friction"] = np.array([[0.0, 0.0], [0.0, 0.2]])
    reset_all(physics, resting(2, velocity=[0.0, 2.0]), parameters)
    frictionless, rubbing = physics.step(np.tile([0.0, target], (2, 1))).joint_velocity[:, 1]
    assert frictionless == pytest.approx(1.6, abs=0.1)
    assert rubbing == pytest.approx(2.0 - (2.0 - frictionless) * (0.3 + 0.2) / 0.3, abs=0.02)


@pytest.mark.parametrize("changes", [{"payload": [0.0, 1.0]}, {"link_mass": [0.5, 2.0]}], ids=["payload", "link_mass"])
def test_a_heavier_robot_speeds_up_more_slowly(planar, make, changes):
    physics = make(planar, 2)
    found = speeds(physics, dynamics(planar, 2, effort_limit=0.5, **changes), 4)[-1, :, 0]
    assert found[1] < 0.7 * found[0]


def test_damping_slows_an_arm_whose_motors_are_off(planar, make):
    physics = make(planar, 3)
    parameters = dynamics(planar, 3, effort_limit=0.0, joint_friction=0.0, joint_damping=[0.0, 0.2, 1.0])
    found = speeds(physics, parameters, 10, qd=1.0)[-1, :, 0]
    assert found[2] < 0.9 * found[1] < 0.9 * found[0]


def test_an_arm_without_motor_friction_and_damping_keeps_turning(planar, make):
    physics = make(planar, 1)
    parameters = dynamics(planar, 1, joint_friction=0.0, joint_damping=0.0)
    parameters["effort_limit"] = np.array([[0.0, 100.0]])  # the second joint is held
    reset_all(physics, resting(1, velocity=[1.0, 0.0]), parameters)
    assert run(physics, np.zeros((50, 1, 2)))[-1, 1, 0, 0] == pytest.approx(1.0, abs=1e-3)


def test_torque_over_inertia_is_the_acceleration(planar, make):
    physics = make(planar, 1)
    parameters = dynamics(planar, 1, joint_friction=0.0, joint_damping=0.0, payload=0.3)
    parameters["effort_limit"] = np.array([[0.8, 100.0]])
    reset_all(physics, resting(1), parameters)
    speed = run(physics, np.tile([2.0, 0.0], (5, 1, 1)))[-1, 1, 0, 0]
    # about joint 1, with the arm stretched; the payload enlarges the tool, its own inertia too
    inertia = 0.00771 + 1.0 * 0.15**2 + 0.00319 + 0.6 * 0.425**2 + 1e-5 * 7 + 0.35 * 0.55**2
    assert speed == pytest.approx(5 * DT * 0.8 / inertia, rel=0.01)


def test_a_payload_pulls_a_weak_kuka_down(kuka_reacher, make):
    spec = RobotSpec.from_config(kuka_reacher.robot)
    physics = make(spec, 2)
    parameters = dynamics(spec, 2, effort_limit=60.0, payload=[0.0, 5.0])
    reset_all(physics, resting(2, [0.0, np.pi / 2]), parameters)
    drop = np.abs(run(physics, np.zeros((20, 2, 2)))[-1, 0, :, 1] - np.pi / 2)
    assert drop[1] > drop[0] + 0.01


def test_more_substeps_divide_the_control_period(planar, make):
    for substeps in (1, 4):
        physics = make(planar, 1, substeps=substeps)
        reset_all(physics, resting(1, velocity=1.0))
        assert run(physics, np.ones((50, 1, 2)))[-1, 0, 0, 0] == pytest.approx(50 * DT, rel=0.02)


def wandering(spec, robots, random):
    """Velocity commands for four seconds that jump five times a second, [T, N, n], within what actions can ask."""
    drawn = random.uniform(-1, 1, (20, robots, len(spec.joints))) * spec.command_limit
    return np.repeat(drawn, 10, axis=0)


@pytest.mark.slow
def test_a_velocity_gain_means_the_same_at_any_number_of_substeps(two_joint_env, make):
    # An effort limit that ends within a control period makes a difference by itself, which is not the gain's. Measured
    # with and without gains, RMS over 4 s: 1.7 and 1.1 mrad on the KUKA, 9.3 and 8.9 on the planar arm. Seven joints
    # under gravity, with gains down to 0.3, differ by more: a Panda's by 45 and 20 mrad at 20 substeps.
    spec = RobotSpec.from_config(two_joint_env.robot)
    random = np.random.default_rng(0)
    full = dynamics(spec, 32)
    gains = {**full, "velocity_gain": random.uniform(0.3, 1.0, full["velocity_gain"].shape)}
    begin, given = start(spec, 32, random), wandering(spec, 32, random)

    def difference(parameters, substeps):
        found = []
        for number in (1, substeps):
            physics = make(spec, 32, substeps=number)
            reset_all(physics, begin, parameters)
            found.append(run(physics, given)[:, 0])
        np.testing.assert_array_equal(physics.parameters()["velocity_gain"], parameters["velocity_gain"])
        return np.sqrt(np.mean((found[1] - found[0]) ** 2))

    for substeps in (2, 20):
        assert difference(gains, substeps) < difference(full, substeps) + 0.003


@pytest.mark.parametrize("substeps", [1, 20])
def test_a_velocity_gain_is_a_time_constant(planar, make, substeps):
    physics = make(planar, 3, substeps=substeps)
    gain = np.array([0.2, 0.5, 0.9])
    parameters = dynamics(planar, 3, velocity_gain=gain, effort_limit=100.0, joint_friction=0.0, joint_damping=0.0)
    reset_all(physics, resting(3), parameters)
    position = run(physics, np.tile([1.0, 0.0], (100, 3, 1)))[-1, 0, :, 0]
    behind = 100 * DT - position  # rad; at 1 rad/s, what a first-order lag loses is its time constant in seconds
    np.testing.assert_allclose(behind, DT * (1 - gain) / gain, rtol=0.05, atol=1e-4)
