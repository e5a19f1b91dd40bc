"""Motions: within what a robot may do, each after a rest, and home again, also of a robot that does not follow well."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physai.errors import UserError
from physai.identify.motions import Bounds, Excitation, plan, simulate
from physai.identify.recording import Recording
from physai.identify.trials import cut
from physai.physics import ParameterLayout, Physics, RobotState
from physai.robots import RobotSpec
from physai.targets import make

MARGIN = 0.1  # rad
TWO = Bounds(np.array([[-2.0, 2.0], [-np.inf, np.inf]]), MARGIN, np.array([0.3, 0.3]), 2.0, np.array([0.5, 3.0]))


@st.composite
def bounds(draw):
    n = draw(st.integers(1, 4))
    home = np.array(draw(st.lists(st.floats(-1.0, 1.0), min_size=n, max_size=n)))
    room = st.floats(MARGIN + 0.05, 2.0)
    sides = [(home[joint] - draw(room), home[joint] + draw(room)) for joint in range(n)]
    velocity = draw(st.lists(st.floats(0.05, 3.0), min_size=n, max_size=n))
    return Bounds(np.array(sides), MARGIN, np.array(velocity), draw(st.floats(0.5, 1000.0)), home)


def names(bounds):
    return [f"joint{number}" for number in range(1, len(bounds.home) + 1)]


def begins(command, period, seconds):
    """Steps at which a command other than zero comes after so long a rest."""
    moving = np.flatnonzero(command.any(axis=1))
    return [
        int(step) for last, step in zip([-1, *moving], moving, strict=False) if (step - last - 1) * period >= seconds
    ]


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(bounds(), st.sampled_from([0.01, 0.02, 0.05]), st.integers(0, 99))
def test_plans_keep_limits_velocities_and_accelerations_and_end_at_home_at_rest(bounds, period, seed):
    motions = plan(bounds, names(bounds), period, 15.0, seed)
    command, position = simulate(Excitation(bounds, motions, period), bounds.home)
    assert (np.abs(command) <= bounds.velocity + 1e-9).all()
    changes = np.diff(command, axis=0, prepend=0.0)
    assert (np.abs(changes) <= bounds.acceleration * period + 1e-9).all()
    assert (position >= bounds.position[:, 0] + MARGIN - 1e-6).all()
    assert (position <= bounds.position[:, 1] - MARGIN + 1e-6).all()
    assert (np.abs(position[-1] - bounds.home) < 0.03).all()
    assert not command[-round(0.6 / period) :].any()
    assert all(len(motion.velocity) * period <= 4.0 for motion in motions)
    assert not any(motion.velocity[-1].any() for motion in motions)
    assert len(begins(command, period, 0.6)) >= len(motions)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(bounds(), st.floats(0.3, 1.0), st.integers(0, 8), st.integers(0, 99))
def test_what_a_robot_does_not_follow_does_not_add_up(bounds, gain, delay, seed):
    excitation = Excitation(bounds, plan(bounds, names(bounds), 0.02, 30.0, seed), 0.02)
    position, sent, went = bounds.home.copy(), [np.zeros_like(bounds.home)] * delay, []
    while not excitation.done:
        sent.append(excitation.step(position))
        position = position + gain * sent[-1 - delay] * 0.02
        went.append(position)
        assert len(went) < 10_000
    assert (np.abs(position - bounds.home) < 0.1).all()
    beyond = np.maximum(bounds.position[:, 0] - went, went - bounds.position[:, 1])
    assert beyond.max() < 0.0


def test_every_joint_moves_alone_and_all_together_by_steps_a_chirp_and_a_sweep():
    motions = {motion.name: motion.velocity for motion in plan(TWO, ("a", "b"), 0.02, 30.0, 0)}
    assert set(motions) == {"steps of a", "steps of b", "steps of all joints", "chirp", "slow sweep"}
    for name, moves in (("steps of a", [True, False]), ("steps of b", [False, True])):
        assert motions[name].any(axis=0).tolist() == moves
    for name in ("steps of all joints", "chirp", "slow sweep"):
        assert motions[name].any(axis=0).all()
    assert np.abs(motions["slow sweep"]).max() <= 0.05
    crossings = np.diff(np.sign(motions["chirp"][:, 0])) != 0  # of zero, which come sooner and sooner
    gaps = np.diff(np.flatnonzero(crossings[:130]))
    assert gaps[0] > 2 * gaps[-1]


def test_steps_are_as_fast_as_is_allowed():
    fast = Bounds(TWO.position, MARGIN, np.array([2.0, 1.0]), 1000.0, TWO.home)
    (velocity,) = [each.velocity for each in plan(fast, ("a", "b"), 0.02, 30.0, 0) if "all" in each.name][:1]
    assert (np.abs(velocity).max(axis=0) > 0.7 * fast.velocity).all()
    assert np.abs(np.diff(velocity, axis=0)).max() > 2.0  # from one side to the other at once


def test_a_joint_whose_home_is_at_its_limit_moves_to_the_other_side():
    at_limit = Bounds(np.array([[0.0, 2.0]]), MARGIN, np.array([0.5]), 2.0, np.array([0.0]))
    _, position = simulate(Excitation(at_limit, plan(at_limit, ("a",), 0.02, 20.0, 0), 0.02), at_limit.home)
    assert position.min() > -0.02
    assert position.max() > 0.2


def test_a_home_beyond_the_limits_is_refused():
    wrong = Bounds(np.array([[-1.0, 1.0]]), MARGIN, np.array([0.5]), 2.0, np.array([1.5]))
    with pytest.raises(UserError, match="'elbow': its home is beyond its limits"):
        plan(wrong, ("elbow",), 0.02, 20.0, 0)


def test_a_motion_that_was_interrupted_is_left_out_and_the_next_one_begins_at_home():
    motions = plan(TWO, ("a", "b"), 0.02, 20.0, 0)
    excitation, position = Excitation(TWO, motions, 0.02), TWO.home
    while excitation.number < 2 or np.abs(position - TWO.home).max() < 0.03:
        position = position + excitation.step(position) * 0.02
    excitation.interrupt()
    assert not excitation.step(position)[np.abs(position - TWO.home) < 1e-3].any()
    number = excitation.number
    rest = 0
    while excitation.number == number:
        velocity = excitation.step(position)
        position = position + velocity * 0.02
        rest = 0 if velocity.any() else rest + 1
    assert rest * 0.02 >= 0.6 or velocity.any()
    assert np.abs(position - TWO.home).max() < 0.03
    assert excitation.broken_off == 1


def test_the_time_left_falls_to_zero_and_a_joint_that_turns_without_end_takes_the_shorter_way():
    excitation = Excitation(TWO, plan(TWO, ("a", "b"), 0.02, 15.0, 0), 0.02)
    position = np.array([0.0, -3.0])  # from which 3 rad is nearer by way of pi
    left = [excitation.left(position)]
    while not excitation.done:
        position = position + excitation.step(position) * 0.02
        left.append(excitation.left(position))
    assert left[-1] == 0.0
    assert 15.0 < left[0] < 30.0
    longest = max(np.diff(np.flatnonzero(np.diff(np.minimum.accumulate(left)) < 0)))
    assert longest * 0.02 < 1.0  # without progress: far less than a controller waits
    assert position[1] == pytest.approx(3.0 - 2 * np.pi, abs=0.03)


def test_what_a_simulated_robot_does_is_cut_into_its_motions(env_config):
    config = env_config("reacher")
    spec = RobotSpec.from_config(config.robot)
    fast = Bounds(spec.position_limit, MARGIN, spec.velocity_limit, 1000.0, spec.home)
    excitation = Excitation(fast, plan(fast, spec.joints, config.control_dt, 20.0, 0), config.control_dt)
    physics: Physics = make("physics", config.physics, spec, 1, config.control_dt, needs=("reset", "step", "close"))
    layout = ParameterLayout(spec)
    nominal = layout.dynamics(layout.nominal.double().numpy()[None])
    physics.reset(np.arange(1), RobotState(spec.home[None], np.zeros((1, len(spec.home)))), nominal)
    rows = []
    while not excitation.done:
        state = physics.robot_state()
        command = excitation.step(state.joint_position[0])
        rows.append((state.joint_position[0], state.joint_velocity[0], command, state.joint_effort[0]))
        physics.step(command[None])
    physics.close()
    trials = cut(Recording(config.control_dt, *map(np.array, zip(*rows, strict=True))), "it", spec)
    assert len(trials) == len(excitation.motions)
    assert not trials.left_out
