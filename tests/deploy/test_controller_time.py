"""Rows of the table of faults: updates that come late, and clocks that jump."""

import math

import numpy as np
import pytest

from physai.deploy import Goal, State
from tests.deploy.robot import DEFAULT, FAR_GOAL, PERIOD, Robot, is_stopped, recovers

# Row: update called late.


@pytest.mark.fault("more than three periods between two updates")
def test_a_late_update_is_zero_for_that_tick_and_nothing_is_caught_up(moving):
    command = moving.tick(after=3.1 * PERIOD)
    assert is_stopped(command, State.ACTIVE)
    assert command.reasons == ("update came after 0.062 s, 3.1 periods",)
    assert moving.counters["late updates"] == 1
    speeds = [np.abs(moving.tick().value).max() for _ in range(3)]
    np.testing.assert_allclose(speeds, [0.04, 0.08, 0.12], rtol=1e-6)


def test_an_update_within_three_periods_is_not_late_and_accelerates_as_one_period_would(robot):
    robot.tick(goal=FAR_GOAL)
    speeds = [np.abs(robot.tick(after=2.9 * PERIOD).value).max() for _ in range(3)]
    np.testing.assert_allclose(speeds, [0.08, 0.12, 0.16], rtol=1e-6)
    assert "late updates" not in robot.counters


def test_updates_that_come_faster_than_the_rate_accelerate_no_faster(robot):
    robot.tick(goal=FAR_GOAL)
    for _ in range(30):
        before = robot.controller.snapshot()["command"]
        change = robot.tick(after=0.002).value - before
        assert np.abs(change).max() <= 2.0 * 0.002 + 1e-9
    frozen = robot.tick(after=0.0, state=None)
    assert frozen.value.tolist() == robot.controller.snapshot()["command"]


def test_a_late_update_at_a_reached_goal_does_not_leave_it(robot):
    robot.tick(goal=Goal(robot.tip(), "base"))
    for command in (robot.tick(), robot.tick(after=0.08), robot.tick()):
        assert is_stopped(command, State.REACHED)
    assert robot.counters["entered reached"] == 1


# Row: now jumps.


@pytest.mark.parametrize("jump", [-1e6, -5.0, -0.001, 1.1, 5.0, 1e9])
@pytest.mark.fault("clock jumps backwards or far ahead, or stands still")
def test_a_jump_of_the_clock_holds(moving, jump):
    moving.now += jump
    command = moving.controller.update(moving.now, moving.state(stamp=0.0) if jump > 0 else None)
    assert is_stopped(command, State.HOLD)
    assert moving.counters["holds: clock"] == 1
    assert any("the clock jumped by" in reason for reason in command.reasons)


@pytest.mark.parametrize("jump", [-5.0, -0.021, 1.1, 5.0])
def test_after_a_jump_of_the_clock_it_recovers_with_states_stamped_by_another_clock(moving, jump):
    stamp = moving.now

    def tick(after=PERIOD):
        nonlocal stamp
        stamp += PERIOD
        return moving.tick(after=after, stamp=stamp)

    assert is_stopped(tick(jump), State.HOLD)  # the state that comes with it does not count
    for _ in range(4):
        assert is_stopped(tick(), State.HOLD)
    assert np.abs(tick().value).max() == pytest.approx(0.04)


def test_the_position_that_comes_with_a_late_update_is_taken_but_does_not_count_for_recovery(moving):
    moving.ticks(7, state=None)
    moving.ticks(3)
    assert is_stopped(moving.tick(after=0.08), State.HOLD)
    assert moving.controller.snapshot()["joint_state_age"] == 0.0
    assert recovers(moving, stay_for=1)


@pytest.mark.fault("clock jumps backwards or far ahead, or stands still")
def test_a_clock_that_stands_still_holds_from_the_third_further_update_on(moving):
    for _ in range(2):
        assert moving.tick(after=0.0, state=None).value.any()
    stamp = moving.now
    for tick in range(20):
        command = moving.tick(after=0.0, stamp=stamp + (tick + 1) * PERIOD)
        assert is_stopped(command, State.HOLD)
        assert command.reasons[0] == "the clock stands still"
    assert moving.counters["holds: clock"] == 1
    moving.now += 1.0  # so that stamps go on
    moving.tick()
    assert recovers(moving)


def test_updates_two_or_three_at_a_time_are_no_clock_that_stands_still(moving):
    for after in (0.0, 0.0, PERIOD) * 10:
        assert moving.tick(after=after, state=None if not after else DEFAULT).value.any()


def test_holds_are_counted_once_each_however_long_they_last(moving):
    for count in (1, 2):
        assert is_stopped(moving.ticks(50, state=None)[-1], State.HOLD)
        assert moving.counters["holds: state old"] == count
        assert recovers(moving)


def test_after_the_clock_jumped_back_old_states_are_still_noticed(moving):
    for _ in range(3):
        assert is_stopped(moving.tick(after=-50.0, state=None), State.HOLD)
    moving.now += 1000  # so that stamps go on
    moving.ticks(10)
    assert moving.tick().state is State.ACTIVE
    assert is_stopped(moving.ticks(6, state=None)[-1], State.HOLD)


@pytest.mark.parametrize("now", [math.nan, math.inf, -math.inf])
def test_a_time_that_is_not_finite_holds(moving, now):
    command = moving.controller.update(now, moving.state(stamp=moving.now + 0.01))
    assert is_stopped(command, State.HOLD)
    assert "the time is not finite" in command.reasons
    assert recovers(moving)


def test_a_jump_of_the_clock_holds_even_where_one_good_state_ends_a_hold(policy):
    robot = Robot(policy, recovery_states=1)
    robot.drive()
    assert is_stopped(robot.tick(after=5.0), State.HOLD)
    assert recovers(robot, stay_for=0)
