"""Rows of the table of faults: a policy that fails, or wants too much."""

import numpy as np
import pytest

from physai.deploy import Goal, State
from tests.deploy.robot import FAR_GOAL, PERIOD, is_stopped, recovers
from tests.deploy.troubled import ALL_FAILURES, ERRORS

# Row: policy output NaN, wrong shape, exception, too slow.


@pytest.mark.parametrize("failure", ALL_FAILURES)
@pytest.mark.fault("policy gives NaN or another shape (commands or memory), raises, is too slow")
def test_a_policy_that_fails_stops_the_arm_at_once_and_three_times_in_a_row_is_a_fault(moving, failure):
    moving.policy.trouble = failure
    for count, state in enumerate([State.ACTIVE, State.ACTIVE, State.FAULT], start=1):
        command = moving.tick()
        assert is_stopped(command, state)
        assert command.reasons[0].startswith("the policy ")
        assert moving.controller.snapshot()["policy_failures_in_a_row"] == count
    moving.policy.trouble = None
    for command in moving.ticks(100):
        assert is_stopped(command, State.FAULT)
        assert command.reasons[0].startswith("the policy failed 3 times in a row")
    assert recovers(moving, reset=True)


@pytest.mark.parametrize("failure", ALL_FAILURES)
def test_a_policy_that_fails_now_and_then_is_no_fault_and_starts_from_zero_each_time(moving, failure):
    for _ in range(10):
        moving.policy.trouble = failure
        for command in moving.ticks(2):
            assert is_stopped(command, State.ACTIVE)
        moving.policy.trouble = None
        assert np.abs(moving.tick().value).max() == pytest.approx(2.0 * PERIOD)
    assert "faults: policy" not in moving.counters


def test_after_a_reset_failures_of_the_policy_are_counted_anew(moving):
    moving.policy.trouble = "NaN"
    assert is_stopped(moving.ticks(3)[-1], State.FAULT)
    moving.controller.reset()
    moving.ticks(4, goal=FAR_GOAL)
    for state in (State.ACTIVE, State.ACTIVE, State.FAULT):
        assert is_stopped(moving.tick(), state)


def test_an_error_that_raises_is_a_failure_of_the_policy(moving, monkeypatch):
    def error(*arguments):
        raise RuntimeError("gone")

    monkeypatch.setattr(moving.policy, "error", error)
    for state in (State.ACTIVE, State.ACTIVE, State.FAULT):
        assert is_stopped(moving.tick(), state)
    assert moving.counters["policy failures: exception"] == 3


@pytest.mark.parametrize("failure", ERRORS)
def test_an_error_that_cannot_be_is_counted_and_does_not_leave_a_reached_goal(robot, failure):
    robot.tick(goal=Goal(robot.tip(), "base"))
    robot.policy.trouble = failure
    for command in robot.ticks(2):
        assert is_stopped(command, State.REACHED)
        assert command.reasons[0].startswith("the policy gave the error ")
    assert is_stopped(robot.tick(), State.FAULT)
    assert robot.counters["policy failures: error"] == 3


@pytest.mark.parametrize(
    ("message", "told"),
    [("In the TorchScript interpreter.\nTraceback\nthe cause\n\n", "the cause"), ("", "no reason given")],
)
def test_the_reason_of_an_exception_is_the_last_line_of_its_message(moving, message, told):
    def fail(command):
        raise RuntimeError(message)

    moving.policy.trouble = fail
    assert moving.tick().reasons == (f"the policy raised RuntimeError: {told}",)


# Row: policy output beyond its range.


@pytest.mark.fault("policy gives more than its range")
def test_a_command_beyond_the_policy_s_range_is_clamped_and_counted(moving):
    moving.policy.trouble = lambda command: np.array([1e6, -1.0])
    command = moving.ticks(30)[-1]
    assert command.state is State.ACTIVE
    np.testing.assert_allclose(command.value, [0.3, -0.15])  # of [2, -1]
    assert command.reasons == ("the policy's command was beyond its range",)
    assert moving.counters["commands clamped"] == 30
