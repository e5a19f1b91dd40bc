"""Rows of the table of faults: goals that cannot be taken; goals that are reached, and forgotten."""

import numpy as np
import pytest

from physai.deploy import Goal, State
from tests.deploy.robot import BAD_GOALS, FAR_GOAL, PERIOD, Robot, is_stopped

# Row: goal NaN, wrong size, wrong frame.


@pytest.mark.parametrize(("kind", "bad"), BAD_GOALS.items())
@pytest.mark.fault("goal not finite, of another size or frame")
def test_a_bad_goal_is_rejected_counted_and_the_old_one_stays(policy, kind, bad):
    robot, undisturbed = Robot(policy), Robot(policy)
    for each in (robot, undisturbed):
        each.drive()
    command = robot.tick(goal=bad)
    assert command.reasons[0].startswith("goal rejected: ")
    assert command.value.tolist() == undisturbed.tick().value.tolist()
    assert robot.counters[f"goals rejected: {kind}"] == 1
    assert robot.controller.snapshot()["goal"] == FAR_GOAL.value
    assert robot.tick().reasons == ()


def test_a_bad_goal_is_no_goal(robot):
    robot.tick(goal=BAD_GOALS["not finite"])
    command = robot.tick()
    assert is_stopped(command, State.WAITING)
    assert command.reasons == ("no goal yet",)


# Row: goal unreachable.


@pytest.mark.fault("goal nearer or farther than those that the policy was trained on")
def test_an_unreachable_goal_is_projected_onto_the_reachable_ones_where_that_is_set(policy):
    robot = Robot(policy, unreachable_goal="project")
    robot.drive()
    command = robot.tick(goal=Goal([0.0, 4.0], "base"))
    assert command.reasons == ("goal out of reach: [0.0, 0.53] is the nearest in reach",)
    assert command.value.any()
    assert robot.controller.snapshot()["goal"] == [0.0, 0.53]
    assert robot.tick(goal=FAR_GOAL).reasons == ()
    assert robot.counters["goals projected"] == 1


# A goal that is forgotten.


def test_without_its_goal_it_waits_at_once_for_a_new_one(moving):
    moving.controller.forget_goal()
    for command in moving.ticks(3):
        assert is_stopped(command, State.WAITING)
        assert command.reasons == ("no goal yet",)
    assert moving.controller.snapshot()["goal"] is None
    assert np.abs(moving.tick(goal=FAR_GOAL).value).max() == pytest.approx(2.0 * PERIOD)


def test_a_reached_goal_that_is_forgotten_and_said_again_is_not_yet_reached(robot):
    goal = Goal(robot.tip(), "base")
    robot.tick(goal=goal)
    while robot.distance(goal.value) < 0.06:
        robot.position[0] += 0.01
        assert is_stopped(robot.tick(), State.REACHED)
    robot.controller.forget_goal()
    assert robot.tick(goal=goal).state is State.ACTIVE


@pytest.mark.parametrize("state", [State.ESTOP, State.FAULT, State.HOLD])
def test_to_forget_a_goal_ends_no_stop(moving, state):
    if state is State.ESTOP:
        moving.controller.emergency_stop()
    elif state is State.FAULT:
        moving.policy.trouble = "NaN"
        moving.ticks(3)
    else:
        moving.ticks(6, state=None)
    moving.controller.forget_goal()
    for command in moving.ticks(3, goal=FAR_GOAL):
        assert is_stopped(command, state)


# Reached.


def test_at_the_goal_it_stands_until_the_goal_moves(robot):
    robot.tick(goal=Goal(robot.tip(), "base"))
    for command in (*robot.ticks(20), robot.tick(goal=Goal(robot.tip(), "base"))):
        assert is_stopped(command, State.REACHED)
        assert command.reasons == ()
    assert robot.tick(goal=FAR_GOAL).state is State.ACTIVE


def test_a_reached_goal_is_left_only_at_one_and_a_half_tolerances(robot):
    robot.tick(goal=Goal(robot.tip(), "base"))
    goal = robot.controller.snapshot()["goal"]
    states, distances = [], []
    for offset in [*np.arange(0.0, 0.3, 0.01), *np.arange(0.3, 0.0, -0.01)]:  # away, and back
        robot.position = [0.5 + offset, 1.0]
        states.append(robot.tick().state)
        distances.append(robot.distance(goal))
    reached = True
    for state, distance in zip(states, distances, strict=True):
        reached = distance < (0.075 if reached else 0.05)
        assert state is (State.REACHED if reached else State.ACTIVE)
    assert states.count(State.ACTIVE) > 10


@pytest.mark.parametrize(("moved", "state"), [(0.0049, State.REACHED), (0.0051, State.ACTIVE)])
def test_between_one_and_one_and_a_half_tolerances_it_stands_until_the_goal_moves_by_a_tenth(robot, moved, state):
    x, y = robot.tip()
    robot.tick(goal=Goal([x, y], "base"))
    while robot.distance([x, y]) < 0.06:
        robot.position[0] += 0.01
        assert is_stopped(robot.tick(goal=Goal([x, y], "base")), State.REACHED)
    for goal in ([x + moved, y], [x, y + moved]):
        if 0.055 < robot.distance(goal) < 0.07:
            break
    assert robot.tick(goal=Goal(goal, "base")).state is state
    assert robot.controller.snapshot()["goal"] == goal


def test_a_hold_at_the_goal_ends_at_the_goal(robot):
    robot.tick(goal=Goal(robot.tip(), "base"))
    assert is_stopped(robot.ticks(7, state=None)[-1], State.HOLD)
    assert is_stopped(robot.ticks(5)[-1], State.REACHED)
