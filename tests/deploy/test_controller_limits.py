"""Rows of the table of faults: joints beyond their position limits, and other limits while the arm moves."""

import numpy as np
import pytest

from physai.deploy import ControllerConfig, Goal, State
from physai.errors import UserError
from tests.deploy.robot import FAR_GOAL, LENIENT, PERIOD, Robot, configure, is_stopped, recovers

# Row: position beyond its limit.


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.fault("joint beyond its position limit")
def test_beyond_a_limit_it_moves_slowly_inward_and_not_outward(robot, side):
    robot.position = [0.0, side * 2.65]
    robot.tick(goal=FAR_GOAL)
    for push in (1.0, -1.0):
        robot.policy.trouble = lambda command, push=push: np.array([0.5, push])
        command = robot.ticks(30)[-1]
        assert command.state is State.ACTIVE
        inward = -side * push > 0
        np.testing.assert_allclose(command.value, [0.025, push * 0.05] if inward else [0.025, 0.0], atol=1e-9)


def test_at_a_limit_outward_motion_stops_at_once(robot):
    robot.policy.trouble = lambda command: np.array([0.0, 2.0])
    robot.position = [0.0, 2.4]
    robot.tick(goal=FAR_GOAL)
    command = robot.ticks(20)[-1]
    assert command.value.tolist() == pytest.approx([0.0, 0.3])
    assert command.reasons == ()
    robot.position = [0.0, 2.51]
    for command in robot.ticks(3):
        assert is_stopped(command, State.ACTIVE)
        assert command.reasons == ("a joint is at its position limit: no motion outward",)
    assert robot.counters["ticks at a position limit"] == 3


@pytest.mark.fault("joint beyond its position limit")
def test_far_beyond_a_limit_is_a_fault(moving):
    moving.position = [0.5, -2.85]
    commands = moving.ticks(2, velocity=(0.0, -7.0), after=0.9)
    assert is_stopped(commands[0], State.FAULT)
    assert "'joint2' is far beyond its position limit, at -2.850 rad" in commands[0].reasons
    moving.position = [0.5, 1.0]
    for command in moving.ticks(100):
        assert is_stopped(command, State.FAULT)
        assert command.reasons[-1].startswith("'joint2' is far beyond")
    assert recovers(moving, reset=True)


def test_a_reset_far_beyond_a_limit_ends_in_the_same_fault(robot):
    robot.position = [0.5, 2.85]
    assert is_stopped(robot.tick(goal=FAR_GOAL), State.FAULT)
    robot.controller.reset()
    assert is_stopped(robot.tick(state=None), State.HOLD)
    assert is_stopped(robot.tick(), State.FAULT)


@pytest.mark.parametrize("timeout", [0.1, 0.4])
@pytest.mark.parametrize("speed", [0.3, 2.0])
def test_an_arm_that_is_not_heard_of_for_a_while_stays_within_its_limits(policy, speed, timeout):
    margin = speed * (timeout + 3 * PERIOD) + 1e-6
    robot = Robot(policy, max_velocity=speed, max_acceleration=50.0, state_timeout=timeout, limit_margin=margin)
    robot.policy.trouble = lambda command: np.array([0.0, 2.0])
    robot.position = [0.0, 1.0]
    command = robot.tick(goal=FAR_GOAL)
    heard = True
    while command.state is State.ACTIVE:
        robot.position[1] += command.value[1] * PERIOD
        heard &= robot.position[1] < 2.6 - margin - 1e-3
        command = robot.tick(velocity=command.value) if heard else robot.tick(state=None)
    assert is_stopped(command, State.HOLD)
    assert 2.6 - margin < robot.position[1] <= 2.6


# Other limits while it runs.


def test_a_lower_velocity_holds_at_once_and_keeps_the_direction_and_a_higher_one_is_accelerated_to(moving):
    before = moving.tick().value
    configure(moving, max_velocity=0.1)
    np.testing.assert_allclose(moving.tick().value, before / 3, atol=1e-3)
    configure(moving, max_velocity=0.2, max_acceleration=1.0)
    speeds = [np.abs(moving.tick().value).max() for _ in range(6)]
    np.testing.assert_allclose(speeds, [0.12, 0.14, 0.16, 0.18, 0.2, 0.2], rtol=1e-6)
    assert moving.controller.config.max_velocity == 0.2


def test_another_state_timeout_holds_from_the_next_update_on(moving):
    moving.ticks(3, state=None)
    configure(moving, state_timeout=0.07)
    assert is_stopped(moving.tick(state=None), State.HOLD)
    configure(moving, recovery_states=2)
    assert is_stopped(moving.tick(state=None), State.HOLD)
    moving.ticks(5)
    assert is_stopped(moving.ticks(6, state=None)[-1], State.HOLD)
    assert recovers(moving, stay_for=1)


def test_other_limits_on_joint_states_and_goals_hold_from_the_next_update_on(moving):
    configure(moving, allow_velocity_estimate=True, unreachable_goal="project")
    command = moving.tick(velocity=(), goal=Goal([0.0, 4.0], "base"))
    assert command.state is State.ACTIVE
    assert command.reasons == ("goal out of reach: [0.0, 0.53] is the nearest in reach",)
    configure(moving, jump_factor=1.0)
    assert is_stopped(moving.tick(velocity=(0.0, 2.6)), State.HOLD)


def test_a_wider_margin_stops_outward_motion_at_once(robot):
    robot.policy.trouble = lambda command: np.array([0.0, 2.0])
    robot.position = [0.0, 2.4]
    robot.tick(goal=FAR_GOAL)
    assert robot.ticks(10)[-1].value[1] > 0.2
    configure(robot, limit_margin=0.21)
    assert is_stopped(robot.tick(), State.ACTIVE)


def test_other_limits_change_nothing_else(policy):
    robot, untouched = Robot(policy), Robot(policy)
    for each in (robot, untouched):
        each.drive()
    configure(robot)
    assert robot.tick().value.tolist() == untouched.tick().value.tolist()
    for each in (robot, untouched):
        each.ticks(6, state=None)
    configure(robot)
    assert robot.controller.snapshot() == untouched.controller.snapshot()
    assert recovers(robot)


def test_limits_that_do_not_fit_the_robot_are_refused_and_those_of_before_stay(moving, policy):
    undisturbed = Robot(policy)
    undisturbed.drive()
    for values in ({"max_velocity": 2.6}, {"state_timeout": 5.0}, {"limit_margin": 0.01}, {"clock_jump": 0.05}):
        with pytest.raises(UserError, match=r"^\w+: "):
            configure(moving, max_acceleration=0.1, recovery_states=1, **values)
    assert moving.controller.config == ControllerConfig(**LENIENT)
    for arguments in (*({},) * 3, *({"state": None},) * 6, *({},) * 6):
        ours, theirs = moving.tick(**arguments), undisturbed.tick(**arguments)
        assert (ours.value.tolist(), ours.state) == (theirs.value.tolist(), theirs.state)
