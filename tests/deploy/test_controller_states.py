"""Rows of the table of faults: joint states that are missing, old, malformed or implausible."""

import math

import numpy as np
import pytest

from physai.deploy import State
from tests.deploy.robot import FAR_GOAL, MALFORMED, NAMES, PERIOD, Robot, is_stopped, recovers

# Row: no state yet.


@pytest.mark.fault("no joint state yet")
def test_without_a_state_it_waits_and_sends_nothing(robot):
    for command in (*robot.ticks(20, state=None), robot.tick(state=None, goal=FAR_GOAL)):
        assert command.value is None
        assert command.state is State.WAITING
        assert command.reasons == ("no joint state yet",)


@pytest.mark.parametrize("wrong", [{"names": ("a", "b")}, {"position": (math.nan, 0.0)}, {"after": 5.0, "state": None}])
def test_before_the_first_good_state_it_sends_nothing_whatever_goes_wrong(robot, wrong):
    for command in (robot.tick(state=None), *robot.ticks(10, **wrong), robot.tick(after=-50.0, state=None)):
        assert command.value is None
        assert command.state is State.WAITING


def test_without_a_goal_it_waits_at_zero(robot):
    for command in robot.ticks(10):
        assert is_stopped(command, State.WAITING)
        assert command.reasons == ("no goal yet",)


def test_with_a_state_and_a_goal_it_drives_from_zero_through_the_acceleration_limit(robot):
    robot.tick()
    speeds = [np.abs(robot.tick(goal=FAR_GOAL).value).max() for _ in range(10)]
    np.testing.assert_allclose(speeds, [0.04, 0.08, 0.12, 0.16, 0.2, 0.24, 0.28, 0.3, 0.3, 0.3], rtol=1e-6)


# Row: state older than state_timeout.


@pytest.mark.fault("state older than `state_timeout` (0.1 s)")
def test_an_old_state_holds_and_five_good_ones_resume(moving):
    for command in moving.ticks(5, state=None):
        assert command.state is State.ACTIVE
    for command in moving.ticks(3, state=None):
        assert is_stopped(command, State.HOLD)
        assert "joint state is 0.1" in command.reasons[0]
    assert recovers(moving)


def test_a_state_that_is_old_when_it_comes_holds(moving):
    command = moving.tick(received=moving.now + PERIOD - 0.11)
    assert is_stopped(command, State.HOLD)
    assert moving.counters["states rejected: old on arrival"] == 1
    assert recovers(moving)


def test_the_age_of_a_state_counts_from_when_it_set_out(moving):
    assert moving.tick(received=moving.now + PERIOD - 0.09).state is State.ACTIVE
    assert is_stopped(moving.tick(state=None), State.HOLD)


def test_a_state_from_the_future_counts_as_new_but_not_as_newer(moving):
    moving.tick(received=moving.now + 1000)
    moving.ticks(5, state=None)
    assert is_stopped(moving.tick(state=None), State.HOLD)


def test_a_state_whose_time_of_arrival_is_nan_holds(moving):
    assert is_stopped(moving.tick(received=math.nan), State.HOLD)


def test_a_gap_while_it_recovers_starts_the_count_anew(moving):
    moving.ticks(8, state=None)
    moving.ticks(3)
    moving.ticks(8, state=None)
    assert recovers(moving)


# Row: joints reordered, extra joints.


@pytest.mark.fault("joints reordered, extra joints")
def test_reordered_and_extra_joints_make_no_difference(policy):
    plain, mixed = Robot(policy), Robot(policy)
    for robot in (plain, mixed):
        robot.tick(goal=FAR_GOAL)
    q1, q2 = plain.position
    changes = {
        "names": ("x", "joint2", "y", "joint1"),
        "position": (7.0, q2, 8.0, q1),
        "velocity": (9.0, -0.1, 9.0, 0.2),
    }
    for _ in range(20):
        expected, command = plain.tick(velocity=(0.2, -0.1)), mixed.tick(**changes)
        assert command.state is State.ACTIVE
        assert command.value.tolist() == expected.value.tolist()


# Row: duplicate name, lengths disagree, NaN/inf position.


@pytest.mark.parametrize(("kind", "bad"), MALFORMED.items())
@pytest.mark.fault("joint named twice, lengths disagree, position NaN or infinite")
def test_a_malformed_state_is_rejected_counted_and_soon_too_old(moving, kind, bad):
    for command in moving.ticks(5, **bad):
        assert command.state is State.ACTIVE
        assert command.value.any()
        assert command.reasons[0].startswith("joint state rejected: ")
    assert is_stopped(moving.tick(**bad), State.HOLD)
    assert moving.counters[f"states rejected: {kind.strip()}"] == 6
    assert recovers(moving)


@pytest.mark.parametrize("bad", ["a state", 1.0, {}, (NAMES, [0.5, 1.0])])
def test_a_state_or_goal_that_is_none_is_rejected(moving, bad):
    command = moving.tick(state=bad, goal=bad)
    assert command.state is State.ACTIVE
    assert command.value.any()
    assert [reason.split(" rejected: ")[0] for reason in command.reasons] == ["goal", "joint state"]
    assert moving.counters["states rejected: malformed"] == moving.counters["goals rejected: malformed"] == 1


@pytest.mark.parametrize("bad", MALFORMED.values(), ids=MALFORMED)
def test_good_states_that_end_a_hold_come_in_a_row(moving, bad):
    moving.ticks(8, state=None)
    moving.ticks(4)
    assert is_stopped(moving.tick(**bad), State.HOLD)
    assert recovers(moving)


# Row: velocity empty or NaN.


@pytest.mark.fault("velocity missing or NaN")
def test_a_missing_velocity_is_estimated_where_that_is_allowed(policy):
    robot, knowing = Robot(policy, allow_velocity_estimate=True), Robot(policy)
    for each in (robot, knowing):
        each.drive()
    for _ in range(10):
        assert robot.tick(velocity=(0.0, math.nan)).value.tolist() == knowing.tick().value.tolist()
    assert "states rejected: velocity missing" not in robot.counters


# Row: position jump, stamp running backwards, stamp repeated.

IMPLAUSIBLE = {
    "position jump": {"position": (0.5, 1.2)},
    "stamp repeated": {"stamp": 0.0},
    "stamp backwards": {"stamp": -0.01},
    "velocity implausible": {"velocity": (0.0, 8.0)},
}


@pytest.mark.parametrize(("kind", "bad"), IMPLAUSIBLE.items())
@pytest.mark.fault("position jump, velocity that cannot be true, stamp repeated or backwards")
def test_an_implausible_state_is_rejected_and_holds_at_once(moving, kind, bad):
    if "stamp" in bad:
        bad = {"stamp": moving.now + bad["stamp"]}  # that of the state before, or earlier
    command = moving.tick(**bad)
    assert is_stopped(command, State.HOLD)
    assert command.reasons[0].startswith("joint state rejected: ")
    assert moving.counters[f"states rejected: {kind}"] == moving.counters[f"holds: {kind}"] == 1
    assert moving.controller.snapshot()["last_hold"] == command.reasons[0]
    if kind == "position jump":
        moving.tick()  # the way back is a jump, too
    assert recovers(moving)


def test_a_stamp_far_ahead_does_not_make_a_jump_plausible(moving):
    assert is_stopped(moving.tick(stamp=moving.now + 3600, position=(-2.0, -2.0)), State.HOLD)


@pytest.mark.parametrize("kind", ["stamp repeated", "stamp backwards"])
def test_a_stamp_that_stands_still_or_runs_backwards_holds_as_long_as_it_does(moving, kind):
    stamp = moving.now
    for tick in range(50):
        assert is_stopped(moving.tick(stamp=stamp - (tick * 0.01 if kind == "stamp backwards" else 0.0)), State.HOLD)
    assert recovers(moving)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_continuous_joint_that_is_counted_from_half_a_turn_to_half_a_turn_does_not_stop_there(robot, sign):
    robot.policy.trouble = lambda command: np.array([sign * 2.0, 0.0])
    angle = sign * 3.0
    robot.position = [angle, 1.0]
    command = robot.tick(goal=FAR_GOAL)
    for _ in range(100):
        angle += command.value[0] * PERIOD
        robot.position = [math.remainder(angle, 2 * math.pi), 1.0]
        command = robot.tick(velocity=command.value)
        assert command.state is State.ACTIVE
        assert command.reasons == ()
    assert abs(angle) > 3.5


@pytest.mark.parametrize("turns", [-100, -1, 1, 3])
def test_after_any_number_of_turns_it_drives_as_after_none(policy, turns):
    turned, unturned = Robot(policy), Robot(policy)
    turned.position[0] += turns * 2 * math.pi
    for robot in (turned, unturned):
        robot.tick(goal=FAR_GOAL)
    for _ in range(30):
        np.testing.assert_allclose(turned.tick().value, unturned.tick().value, atol=1e-3)
