"""MuJoCo beside PyBullet, by the same motor law; its own servo; and what it refuses."""

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from physai.physics import ParameterLayout
from physai.physics.mujoco import MuJoCoPhysics, _told
from physai.robots import RobotSpec
from tests.composed import randomization
from tests.physics.conftest import ENGINES, MOTOR
from tests.physics.moving import DT, commands, dynamics, reset_all, resting, run, start, wild

STEPS = 200


@pytest.fixture(scope="module")
def kuka(kuka_reacher):
    return RobotSpec.from_config(kuka_reacher.robot)


@pytest.fixture(scope="module")
def seven(kuka_reacher):
    """The KUKA with all its joints."""
    joints = [f"lbr_iiwa_joint_{number}" for number in range(1, 8)]
    changes = {"joints": joints, "home": [0.0] * 7, "command_limit": [0.5] * 7}
    return RobotSpec.from_config(kuka_reacher.robot.model_copy(update=changes))


def wandering(spec, robots, random):
    """Commands that change smoothly, [T, N, n]."""
    frequency, phase = random.uniform([[[0.1]]] * 2, [[[1.0]], [[2 * np.pi]]], (2, robots, len(spec.joints)))
    time = DT * np.arange(STEPS)[:, None, None]
    return spec.command_limit * np.sin(2 * np.pi * frequency * time + phase)


def apart(spec, begin, parameters, given, substeps=1):
    """How far the engines' joints are apart, rad, RMS."""
    ways = []
    for engine in ("pybullet", "impulse"):
        made = ENGINES[engine](spec, len(given[0]), DT, substeps)
        reset_all(made, begin, parameters)
        ways.append(run(made, given)[:, 0])
        made.close()
    return np.sqrt(np.mean((ways[1] - ways[0]) ** 2))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [dynamics, wild])
@pytest.mark.parametrize("substeps", [1, 4])
def test_robots_go_where_they_go_in_pybullet(spec, kind, substeps):
    random = np.random.default_rng(0)
    parameters = kind(spec, 16, random) if kind is wild else kind(spec, 16)
    begin, given = start(spec, 16, random), wandering(spec, 16, random)
    many = len(spec.joints) > 2  # these stay off their limits, at which the last digits of many joints decide
    assert apart(spec, begin, parameters, 0.3 * given if many else given, substeps) < (5e-3 if many else 1e-4)


@pytest.mark.parametrize("name", ["none", "default", "strong"])
def test_seven_joints_go_where_they_go_in_pybullet(seven, name):
    layout, generator = ParameterLayout(seven), torch.Generator().manual_seed(0)
    parameters = layout.dynamics(randomization(name).sample(16, layout, generator).numpy())
    random = np.random.default_rng(0)
    assert apart(seven, start(seven, 16, random), parameters, wandering(seven, 16, random)) < 1e-3


def test_joints_run_into_their_limits_as_in_pybullet(planar):
    random = np.random.default_rng(0)
    begin = resting(16, [0.0, 2.4])
    given = wandering(planar, 16, random)
    given[:, :, 1] = np.abs(given[:, :, 1])
    assert apart(planar, begin, dynamics(planar, 16), given) < 1e-4


@pytest.mark.parametrize("motor", ["impulse", "servo"])
def test_neither_companions_nor_threads_change_a_bit(spec, motor):
    random = np.random.default_rng(0)
    parameters, begin = wild(spec, 20, random), start(spec, 20, random)
    given = commands(spec, 60, 20, random)
    ways = []
    for rows, threads in ((slice(0, 20), 1), (slice(0, 20), 2), (slice(7, 8), 1)):
        some = dataclasses.replace(
            begin, joint_position=begin.joint_position[rows], joint_velocity=begin.joint_velocity[rows]
        )
        made = MuJoCoPhysics(spec, len(some.joint_position), DT, motor=motor, **MOTOR | {"threads": threads})
        reset_all(made, some, {key: value[rows] for key, value in parameters.items()})
        ways.append(run(made, given[:, rows]))
    np.testing.assert_array_equal(ways[0], ways[1])
    np.testing.assert_array_equal(ways[0][:, :, 7:8], ways[2])


@pytest.mark.parametrize("substeps", [1, 20])
@pytest.mark.parametrize("fastest", [0.015, 0.05])
def test_a_servo_closes_in_with_its_time_constant(planar, substeps, fastest):
    gain = np.array([1.0, 0.5])
    physics = MuJoCoPhysics(planar, 2, DT, substeps, motor="servo", **MOTOR | {"motor_time_constant": fastest})
    parameters = dynamics(planar, 2, velocity_gain=gain, effort_limit=100.0, joint_friction=0.0, joint_damping=0.0)
    reset_all(physics, resting(2), parameters)
    position = run(physics, np.tile([1.0, 0.0], (100, 2, 1)))[-1, 0, :, 0]
    behind = 100 * DT - position  # rad; at 1 rad/s, what a first-order lag loses is its time constant in seconds
    np.testing.assert_allclose(behind, fastest + DT * (1 - gain) / gain, rtol=0.1)


def test_a_servo_s_effort_is_limited_and_dry_friction_holds_what_is_too_weak_for_it(planar):
    physics = ENGINES["servo"](planar, 3, DT)
    parameters = dynamics(planar, 3, effort_limit=[5.0, 0.5, 0.5], joint_friction=[0.05, 0.05, 0.6])
    reset_all(physics, resting(3), parameters)
    strong, weak, stuck = run(physics, np.tile([1.0, 0.0], (3, 3, 1)))[2, 1, :, 0]
    assert strong > 2 * weak > 0.1
    assert abs(stuck) < 0.02  # MuJoCo's friction creeps


@pytest.mark.parametrize("motor", ["impulse", "servo"])
def test_a_motor_with_a_heavier_rotor_speeds_its_joint_up_more_slowly(planar, motor):
    physics = ENGINES[motor](planar, 2, DT)
    parameters = dynamics(planar, 2, effort_limit=1.0, joint_friction=0.0, armature=[0.0, 1.0])
    reset_all(physics, resting(2, [0.0, np.pi / 2]), parameters)
    speeds = physics.step(np.array([[0.0, 5.0]] * 2)).joint_velocity[:, 1]
    assert speeds[1] == pytest.approx(1.0 * DT / 1.0, rel=0.05)  # effort · time / inertia: the arm's is small beside it
    assert speeds[0] > 10 * speeds[1]


def test_a_servo_carries_the_weight_that_is_described_and_lets_a_load_sink(seven):
    raised = [0.0, 0.8, 0.0, -0.9, 0.0, 0.5, 0.0]
    physics, standing = ENGINES["servo"](seven, 2, DT), np.zeros((50, 2, 7))
    reset_all(physics, resting(2, raised, joints=7), dynamics(seven, 2, velocity_gain=0.5, payload=[0.0, 1.0]))
    sunk = np.abs(run(physics, standing)[-1, 0] - raised).max(axis=1)
    assert sunk[0] < 1e-6
    assert sunk[1] > 0.1
    assert np.abs(physics.robot_state().joint_effort[0]).max() > 40.0  # a sensor of torque feels what carries the arm


def test_a_servo_carries_and_drives_with_one_effort_that_is_limited(seven):
    random = np.random.default_rng(0)
    physics = ENGINES["servo"](seven, 8, DT)
    reset_all(physics, start(seven, 8, random), dynamics(seven, 8, effort_limit=40.0, joint_friction=0.0))
    efforts = [physics.step(0.2 * command).joint_effort for command in commands(seven, 50, 8, random)]
    assert np.abs(efforts).max() == pytest.approx(40.0)


def test_a_servo_pushes_a_joint_little_beyond_its_limit(planar):
    physics = ENGINES["servo"](planar, 1, DT)
    reset_all(physics, resting(1, [0.0, 2.4]))
    position = run(physics, np.tile([0.0, 1.0], (50, 1, 1)))[:, 0, 0, 1]
    assert 2.59 < position[-1] < position.max() < 2.63


def test_robots_that_no_step_can_move_are_told_of_once_and_leave_no_file(planar, caplog, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _told.clear()  # by what ran before in this process
    physics = MuJoCoPhysics(planar, 64, DT, motor="servo", **MOTOR | {"threads": 2})
    with caplog.at_level("WARNING", "physai.physics.mujoco"):
        for velocity in ([1e12, 0.0], [0.0, 1e12]):  # of one joint, and of the other
            reset_all(physics, resting(64, velocity=velocity), dynamics(planar, 64))
            physics.step(np.zeros((64, 2)))
    assert [record.getMessage()[:40] for record in caplog.records] == ["MuJoCo: Nan, Inf or huge value in QVEL. "]
    assert not list(tmp_path.iterdir())
    assert "WARNING" not in capfd.readouterr().err


@pytest.mark.slow
def test_a_thousand_robots_have_masses_of_their_own(planar):
    physics = ENGINES["impulse"](planar, 1000, DT)
    parameters = dynamics(planar, 1000, link_mass=np.linspace(0.5, 2, 1000), effort_limit=0.5)
    reset_all(physics, resting(1000), parameters)
    speed = run(physics, np.tile([1.0, 0.0], (3, 1000, 1)))[-1, 1, :, 0]
    assert (np.diff(speed) < 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("found", "line"),
    [
        ("raise ImportError('core and mujoco of\\n unequal version')", "error: core and mujoco of unequal version"),
        ("from mujoco import _gone", "error: "),
    ],
    ids=["mixed", "half"],
)
def test_a_mujoco_that_is_not_whole_ends_in_one_line(tmp_path, found, line):
    (tmp_path / "mujoco").mkdir()
    (tmp_path / "mujoco" / "__init__.py").write_text(found)
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    command = [sys.executable, "-m", "physai.train", "physics=mujoco", f"hydra.run.dir={tmp_path}/run"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 2
    assert done.stderr.startswith(line)
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()
