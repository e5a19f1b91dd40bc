"""Rows of the table of faults: emergency stops, resets and interlocks."""

import pytest

from physai.deploy import Goal, State
from tests.deploy.robot import BAD_GOALS, FAR_GOAL, INTERLOCKS, MALFORMED, Robot, is_stopped, recovers

# Row: emergency stop.


@pytest.mark.fault("`emergency_stop()`")
def test_an_emergency_stop_is_zero_at_once_and_stays_until_reset(moving):
    moving.controller.emergency_stop()
    for command in moving.ticks(200):
        assert is_stopped(command, State.ESTOP)
        assert command.reasons == ("emergency stop",)
    assert moving.counters["emergency stops"] == 1
    assert recovers(moving, reset=True)


@pytest.mark.parametrize("goal", [None, FAR_GOAL])
def test_an_emergency_stop_while_the_policy_thinks_makes_that_very_command_zero(moving, goal):
    moving.policy.stop, moving.policy.trouble = moving.controller.emergency_stop, "emergency stop"
    assert is_stopped(moving.tick(goal=goal), State.ESTOP)
    assert moving.counters["entered estop"] == 1
    moving.policy.trouble = None
    for command in moving.ticks(10, goal=FAR_GOAL):
        assert is_stopped(command, State.ESTOP)
    assert recovers(moving, reset=True)


def test_a_command_that_an_emergency_stop_made_zero_says_so(moving):
    moving.policy.stop, moving.policy.trouble = moving.controller.emergency_stop, "emergency stop"
    assert "emergency stop" in moving.tick().reasons


def test_an_emergency_stop_while_the_policy_fails_for_the_last_time_is_no_mere_fault(moving):
    def fail(command):
        moving.controller.emergency_stop()
        raise RuntimeError("gone")

    moving.policy.trouble = "NaN"
    moving.ticks(2)
    moving.policy.trouble = fail
    assert is_stopped(moving.tick(), State.ESTOP)
    assert is_stopped(moving.tick(), State.ESTOP)


def test_an_emergency_stop_before_the_first_state_sends_zeros(robot):
    robot.controller.emergency_stop()
    assert is_stopped(robot.tick(state=None), State.ESTOP)
    robot.controller.reset()
    command = robot.tick(state=None)
    assert command.value is None
    assert command.state is State.WAITING


def test_nothing_but_a_reset_leaves_an_emergency_stop(moving):
    moving.controller.emergency_stop()
    for arguments in (
        *({"state": None},) * 10,
        *({"goal": goal} for goal in (FAR_GOAL, *BAD_GOALS.values())),
        *MALFORMED.values(),
        {"after": 0.5},
        {"after": 50.0},
        {"after": -50.0},
        *({"position": [0.5, 2.85]},) * 3,
        *({},) * 20,
    ):
        assert is_stopped(moving.tick(**arguments), State.ESTOP)


def test_an_emergency_stop_outranks_a_fault_and_one_reset_ends_both(moving):
    moving.policy.trouble = "NaN"
    moving.ticks(3)
    moving.controller.emergency_stop()
    assert is_stopped(moving.tick(), State.ESTOP)
    assert recovers(moving, reset=True)


def test_a_reset_between_stop_and_update_still_stops(moving):
    moving.controller.emergency_stop()
    assert recovers(moving, reset=True)


def test_a_reset_forgets_goals_and_one_that_comes_after_it_counts_as_soon_as_the_hold_ends(moving):
    moving.controller.emergency_stop()
    moving.tick(goal=FAR_GOAL)
    moving.controller.reset()
    assert moving.controller.snapshot()["goal"] is None
    assert is_stopped(moving.tick(goal=Goal([9.0, 9.0], "base")), State.HOLD)  # refused, so it is none
    assert is_stopped(moving.ticks(5)[-1], State.WAITING)
    moving.controller.emergency_stop()
    moving.controller.reset()
    assert is_stopped(moving.tick(goal=FAR_GOAL), State.HOLD)
    assert recovers(moving, stay_for=3)


def test_a_reset_at_a_reached_goal_forgets_that_it_was_reached(robot):
    robot.tick(goal=Goal(robot.tip(), "base"))
    goal = robot.tip()
    robot.controller.emergency_stop()
    robot.controller.reset()
    robot.ticks(5)
    while robot.distance(goal) < 0.06:
        robot.position[0] += 0.01
        robot.tick()
    assert robot.tick(goal=Goal(goal, "base")).state is State.ACTIVE  # between one and one and a half tolerances


def test_a_reset_without_need_changes_nothing(policy):
    robot, untouched = Robot(policy), Robot(policy)
    for each in (robot, untouched):
        each.drive()
    robot.controller.reset()
    assert robot.tick().value.tolist() == untouched.tick().value.tolist()


# Interlocks.


@pytest.mark.fault('`interlocks=["..."]` given to `update`')
def test_an_interlock_stops_the_arm_at_once_without_a_fault_and_without_asking_the_policy(moving):
    for interlocks in (INTERLOCKS, INTERLOCKS[:1], list(INTERLOCKS[1:])):
        moving.policy.forget()
        command = moving.tick(interlocks=interlocks)
        assert is_stopped(command, State.WAITING)
        assert command.reasons == tuple(interlocks)
        assert moving.policy.error_told is None
        assert not moving.policy.called
    assert {name for name in moving.counters if name.startswith("entered")} == {"entered active", "entered waiting"}


def test_without_interlocks_it_goes_on_from_zero_to_the_goal_that_it_had(moving):
    moving.ticks(10, interlocks=INTERLOCKS)
    assert moving.controller.snapshot()["goal"] == FAR_GOAL.value
    assert recovers(moving, stay_for=0)


def test_an_interlock_and_a_missing_goal_are_both_named(robot):
    assert robot.tick(interlocks=INTERLOCKS).reasons == (*INTERLOCKS, "no goal yet")
    assert robot.tick(interlocks=INTERLOCKS, goal=FAR_GOAL).reasons == INTERLOCKS
    assert robot.tick().value.any()


def test_before_the_first_state_an_interlock_sends_nothing(robot):
    command = robot.tick(state=None, goal=FAR_GOAL, interlocks=INTERLOCKS)
    assert command.value is None
    assert command.state is State.WAITING


def test_what_goes_wrong_during_an_interlock_is_no_less_wrong(moving):
    assert is_stopped(moving.ticks(6, state=None, interlocks=INTERLOCKS)[-1], State.HOLD)
    assert is_stopped(moving.ticks(5, interlocks=INTERLOCKS)[-1], State.WAITING)
    assert is_stopped(moving.tick(interlocks=INTERLOCKS, position=(0.5, 1.9)), State.HOLD)
    moving.position = [0.5, 2.85]
    assert is_stopped(moving.ticks(2, interlocks=INTERLOCKS)[-1], State.FAULT)
    moving.controller.emergency_stop()
    command = moving.tick(interlocks=INTERLOCKS)
    assert is_stopped(command, State.ESTOP)
    assert command.reasons == ("emergency stop",)


def test_a_hold_ends_during_an_interlock(moving):
    moving.ticks(6, state=None)
    for state in (State.HOLD,) * 4 + (State.WAITING,) * 3:
        assert is_stopped(moving.tick(interlocks=INTERLOCKS), state)
    assert recovers(moving, stay_for=0)


def test_a_reached_goal_is_still_reached_after_an_interlock(robot):
    robot.tick(goal=Goal(robot.tip(), "base"))
    goal = robot.controller.snapshot()["goal"]
    while robot.distance(goal) < 0.06:  # between one and one and a half tolerances
        robot.position[0] += 0.01
        assert is_stopped(robot.tick(interlocks=INTERLOCKS), State.WAITING)
    assert is_stopped(robot.tick(), State.REACHED)
