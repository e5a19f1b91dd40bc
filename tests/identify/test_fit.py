"""What is found of hidden robots, and what is said of what cannot be."""

import dataclasses
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from physai.bench.hidden import NOISE, record
from physai.identify.fit import _downhill, fit
from physai.identify.predictor import Predictor
from physai.identify.trials import cut
from physai.identify.unknowns import Unknowns
from physai.physics import ParameterLayout
from physai.robots import RobotSpec
from tests.composed import randomization

ALL = ["link_mass", "payload", "joint_damping", "joint_friction", "velocity_gain"]


@pytest.fixture(scope="module")
def strong():
    return randomization("strong")


def found(hidden, config, names, longest=4):
    trials = cut(hidden.recording, "robot", hidden.spec)
    spec = RobotSpec.from_config(config.robot)
    unknowns = Unknowns.of(names, spec, ParameterLayout(spec))
    with closing(Predictor(spec, config.physics, hidden.recording.period, trials)) as predict:
        return fit(predict, trials, unknowns, longest, 0, lambda _: None)


@pytest.mark.slow
def test_hidden_robots_are_found_within_their_intervals_and_what_holds_them_together_is_named(env_config, strong):
    config = env_config("reacher", "physics=mujoco")
    missed = told = 0
    # Of the first, 15 s tell all of what is asked for below; near the second is another that moves nearly alike.
    for seed, seconds in ((1, 15.0), (2, 30.0)):
        hidden = record(config, strong, ALL, seconds, seed)
        result = found(hidden, config, ALL)
        assert result.delay == hidden.delay
        assert result.explained
        assert (result.after < 1.3 * NOISE[0]).all()
        assert (result.after < 0.2 * result.before).all()
        low, high = result.interval
        truth = hidden.parameters[result.unknowns.columns]
        missed += ((truth < low) | (truth > high))[result.told].sum()
        told += result.told.sum()
        of = dict(zip(result.unknowns.labels, result.told, strict=True))
        assert of["link_mass[link1]"]
        assert of["velocity_gain[joint2]"]
        assert not of["link_mass[tool]"]  # its 50 g are at the tip, as a payload is
        weights = np.abs(result.together[:, list(result.unknowns.labels).index("link_mass[tool]")])
        assert weights.max() > 0.5
    assert told >= 10
    assert missed <= 0.2 * told  # one in twenty is to be expected


@pytest.mark.slow
def test_a_robot_that_the_engine_cannot_be_is_fitted_as_well_as_it_goes_and_the_mismatch_is_said(env_config, strong):
    real = env_config("reacher", "physics=mujoco", "physics.motor=servo", "env.robot.armature=0.01")
    hidden = record(real, strong, ALL, 30.0, 0)
    result = found(hidden, env_config("reacher", "physics=mujoco"), ALL)
    assert not result.explained
    assert (result.after < 0.7 * result.before).all()


@pytest.mark.slow
def test_the_rotor_of_a_drive_is_found_where_nothing_moves_as_it_does(env_config, strong):
    """That of the first joint turns as its link does, about the same axis: only their sum shows."""
    real = env_config("reacher", "physics=mujoco", "physics.motor=servo", "env.robot.armature=0.02")
    names = ["link_mass", "velocity_gain", "armature"]
    hidden = record(real, strong, names, 10.0, 3)
    result = found(hidden, env_config("reacher", "physics=mujoco", "physics.motor=servo"), names, longest=3)
    assert result.explained
    of = dict(zip(result.unknowns.labels, zip(result.values, result.told, strict=True), strict=True))
    value, told = of["armature[joint2]"]
    assert told
    assert value == pytest.approx(0.02, rel=0.1)
    assert not of["armature[joint1]"][1]


@pytest.mark.slow
def test_an_arm_that_sinks_under_its_load_is_found_near_home_from_motions_that_begin_while_it_does(env_config, strong):
    """No other arm of these tests sinks, and no other recording tells of it at the speeds that policies command."""
    config = env_config("kuka_reacher", "physics=mujoco", "physics.motor=servo", "env.robot.home=[0.0,0.7]")
    loaded = strong.model_copy(update={"payload": randomization("wide").payload})
    hidden = record(config, loaded, ["payload", "velocity_gain"], 10.0, 0, feels=True, near=True)
    assert (np.abs(hidden.recording.command) <= hidden.spec.command_limit).all()
    assert (np.abs(hidden.recording.position - hidden.spec.home) < 0.7).all()
    assert np.abs(cut(hidden.recording, "robot", hidden.spec).velocity).max() > 0.04
    result = found(hidden, config, ["payload", "velocity_gain"], longest=3)
    assert result.explained
    assert result.delay == hidden.delay
    truth = hidden.parameters[result.unknowns.columns]
    assert result.values == pytest.approx(truth, abs=0.03)


def test_a_motion_is_predicted_from_the_speed_at_which_it_begins(env_config, strong):
    config = env_config("reacher", "physics=mujoco", "physics.motor=servo")
    hidden = record(config, strong, [], 8.0, 0)
    trials = cut(hidden.recording, "robot", hidden.spec)
    standing = dataclasses.replace(trials, command=np.zeros_like(trials.command))
    moving = dataclasses.replace(standing, velocity=standing.velocity + 0.3)
    velocities, motions = [], np.arange(len(trials))
    for each in (standing, moving):
        with closing(Predictor(hidden.spec, config.physics, hidden.recording.period, each)) as predict:
            velocities.append(predict(hidden.parameters[None], 0.0, each.start[None], motions)[0, 1])
    assert np.abs(velocities[0]).max() < 1e-3
    assert (velocities[1][0] > 0.03).all()  # a drive with a time constant of 15 ms has nearly stopped it in 20 ms
    assert np.abs(velocities[1][10]).max() < 0.01


@pytest.mark.slow
def test_a_parameter_that_shows_in_no_motion_is_not_given_a_number(env_config, strong):
    """A joint that turns without end about a vertical axis moves alike wherever its encoder's zero is."""
    config = env_config("reacher", "physics=mujoco")
    hidden = record(config, strong, ["encoder_offset"], 10.0, 1)
    result = found(hidden, config, ["encoder_offset", "velocity_gain"])
    of = dict(zip(result.unknowns.labels, result.unseen, strict=True))
    assert of["encoder_offset[joint1]"]
    assert not of["velocity_gain[joint1]"]


@pytest.mark.slow
def test_with_efforts_the_scale_of_masses_and_effort_limits_is_found(env_config, strong):
    """Without them it is refused: with twice the masses, damping, friction and effort a robot moves alike.

    Both motors of this robot reach their limits, which are far below those of the description.
    """
    config = env_config("reacher", "physics=mujoco")
    names = [*ALL, "effort_limit"]
    hidden = record(config, strong, names, 20.0, 2, feels=True)
    result = found(hidden, config, names)
    truth = hidden.parameters[result.unknowns.columns]
    wrong = dict(zip(result.unknowns.labels, np.abs(result.values / np.maximum(truth, 1e-9) - 1), strict=True))
    sure = ("link_mass[link1]", "link_mass[link2]", "effort_limit[joint1]", "effort_limit[joint2]")
    assert max(wrong[label] for label in sure) < 0.08
    assert result.explained


@pytest.mark.slow
def test_an_effort_limit_is_found_from_a_higher_one_that_no_motion_reaches(env_config, strong):
    """No slope leads there from the description's limit; from the largest effort that was measured, one does."""
    config = env_config("reacher", "physics=mujoco")
    names = [*ALL, "effort_limit"]
    hidden = record(config, strong, names, 20.0, 9, feels=True)
    result = found(hidden, config, names, longest=3)
    truth = hidden.parameters[result.unknowns.columns]
    at = [result.unknowns.labels.index(f"{name}[joint2]") for name in ("effort_limit", "joint_friction")]
    assert result.values[at].sum() == pytest.approx(truth[at].sum(), rel=0.005)  # it only ever reaches it to brake
    assert (result.after < 1.2 * NOISE[0]).all()


def spoilt(hidden, number):
    """It is said that the commands of a motion came sooner than they did."""
    recording = hidden.recording
    first = round(cut(recording, "robot", hidden.spec).begins[number] / recording.period)
    command = recording.command.copy()
    command[first : first + 60] = recording.command[first + 6 : first + 66]
    return dataclasses.replace(hidden, recording=dataclasses.replace(recording, command=command))


@pytest.mark.slow
def test_motions_in_which_commands_came_late_are_left_out_and_named(env_config, strong):
    config = env_config("reacher", "physics=mujoco")
    hidden = record(config, strong, ["velocity_gain"], 20.0, 2)
    result = found(spoilt(hidden, 1), config, ["velocity_gain", "joint_damping"])
    assert result.spoilt == (1,)
    assert result.delay == hidden.delay
    assert result.explained
    truth = hidden.parameters[hidden.layout.columns["velocity_gain"]]
    np.testing.assert_allclose(result.values[:2], truth, atol=0.02)


@pytest.mark.slow
def test_the_only_motion_by_which_a_fit_is_judged_is_not_left_out(env_config, strong):
    config = env_config("reacher", "physics=mujoco")
    hidden = record(config, strong, ["velocity_gain"], 12.0, 2)
    held_out = np.flatnonzero(cut(hidden.recording, "robot", hidden.spec).held_out)
    assert len(held_out) == 1
    result = found(spoilt(hidden, held_out[0]), config, ["velocity_gain"])
    assert result.spoilt == ()
    assert not result.explained


def test_delays_are_tried_as_long_as_one_near_the_best_is_better():
    def solve(delay):
        tried.append(delay)
        return SimpleNamespace(cost=abs(delay - 5)), delay

    for reach, farthest in ((1, 6), (2, 7)):
        tried: list[int] = []
        found = _downhill(2, range(12), solve, reach)
        assert min(found, key=lambda each: each[0].cost)[1] == 5
        assert max(tried) == farthest
        assert len(tried) == len(set(tried))
