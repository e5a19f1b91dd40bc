"""The controller's table of faults, row by row: what comes in, and what it does."""

import json
import math

import numpy as np
import pytest

from physai.deploy import Controller, ControllerConfig, Goal, JointState, State
from physai.envs.simulation import Simulation
from physai.errors import UserError
from tests.deploy.conftest import ALL_FAILURES, ERRORS, Troubled

PERIOD = 0.02
NAMES = ("joint1", "joint2")
FAR_GOAL = Goal([-0.4, -0.1], "base")  # the arm needs seconds to get there
DEFAULT = object()
# Of an arm that stands where a test puts it, whatever it is told; test_following.py has one that moves.
LENIENT = {"following_error": 100.0, "velocity_error": 100.0, "resume_timeout": 1000.0}


class Robot:
    """A controller, and an arm that stays where it is and is heard of every period unless a test says otherwise."""

    def __init__(self, policy, **config):
        self.policy = Troubled(policy)
        self.controller = Controller(self.policy, ControllerConfig(**LENIENT | config), self.policy.stopwatch)
        self.now, self.position = 100.0, [0.5, 1.0]

    def state(self, **changes):
        return JointState(
            **{"names": NAMES, "position": list(self.position), "velocity": [0.0, 0.0], "stamp": self.now} | changes
        )

    def tick(self, after=PERIOD, state=DEFAULT, goal=None, interlocks=(), **changes):
        self.now += after
        return self.controller.update(self.now, self.state(**changes) if state is DEFAULT else state, goal, interlocks)

    def ticks(self, count, **arguments):
        return [self.tick(**arguments) for _ in range(count)]

    def drive(self):
        """Until it moves at full speed."""
        self.tick(goal=FAR_GOAL)
        command = self.ticks(20)[-1]
        assert command.state is State.ACTIVE
        assert np.abs(command.value).max() == pytest.approx(0.3)
        assert command.reasons == ()
        return command

    def tip(self):
        """A goal at the end effector: by the policy's own kinematics."""
        candidates = [
            [r * math.cos(a), r * math.sin(a)] for r in (0.4, 0.45, 0.5) for a in np.arange(-3.14, 3.14, 0.05)
        ]
        return min(candidates, key=lambda goal: self.policy.error(self.position, goal))

    @property
    def counters(self):
        return self.controller.snapshot()["counters"]


@pytest.fixture
def robot(policy):
    return Robot(policy)


@pytest.fixture
def moving(robot):
    robot.drive()
    return robot


def is_stopped(command, state):
    assert command.state is state
    assert command.value.tolist() == [0.0, 0.0]
    return True


def recovers(robot, stay_for=4, reset=False):
    """It holds for so many good states more, and then starts from zero through the acceleration limit.

    After a reset it needs a new goal, too.
    """
    if reset:
        robot.policy.trouble = None
        robot.controller.reset()
    for left in range(stay_for, 0, -1):
        command = robot.tick()
        assert is_stopped(command, State.HOLD)
        assert command.reasons == (f"{left} more good joint states are needed",)
    if reset:
        for command in robot.ticks(3):
            assert is_stopped(command, State.WAITING)
            assert command.reasons == ("no goal yet",)
    first, second = robot.tick(goal=FAR_GOAL if reset else None), robot.tick()
    assert first.state is second.state is State.ACTIVE
    assert np.abs(first.value).max() == pytest.approx(2.0 * PERIOD)
    assert np.abs(second.value).max() == pytest.approx(4.0 * PERIOD)
    return True


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

MALFORMED = {
    "duplicate name": {"names": ("joint1", "joint1")},
    "lengths disagree": {"position": (0.5, 1.0, 0.0)},
    "position not finite": {"position": (0.5, math.nan)},
    "position not finite ": {"position": (-math.inf, 1.0)},
    "velocity missing": {"velocity": (0.0, math.nan)},
    "stamp not finite": {"stamp": math.nan},
    "malformed": {"position": ("0.5", "1.0")},
    "malformed ": {"stamp": 10**400},
    "malformed  ": {"received": "100.0"},
    "malformed   ": {"received": 10**400},
}


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


# Row: goal NaN, wrong size, wrong frame.

BAD_GOALS = {
    "not finite": Goal([math.nan, 0.4], "base"),
    "malformed": Goal([0.4, 0.0, 0.0], "base"),
    "wrong frame": Goal([0.4, 0.0], "world"),
    "unreachable": Goal([2.0, 2.0], "base"),
}


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
    while robot.policy.error(robot.position, goal) < 0.06:
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

INTERLOCKS = ("not enabled", "a person is near")


@pytest.mark.fault('`interlocks=["..."]` given to `update`')
def test_an_interlock_stops_the_arm_at_once_without_a_fault_and_without_asking_the_policy(moving):
    for interlocks in (INTERLOCKS, INTERLOCKS[:1], list(INTERLOCKS[1:])):
        moving.policy.forget()
        command = moving.tick(interlocks=interlocks)
        assert is_stopped(command, State.WAITING)
        assert command.reasons == tuple(interlocks)
        assert moving.policy.measured is None
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
    while robot.policy.error(robot.position, goal) < 0.06:  # between one and one and a half tolerances
        robot.position[0] += 0.01
        assert is_stopped(robot.tick(interlocks=INTERLOCKS), State.WAITING)
    assert is_stopped(robot.tick(), State.REACHED)


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
    while robot.policy.error(robot.position, goal.value) < 0.06:
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


# Other limits while it runs.


def configure(robot, **values):
    robot.controller.configure(ControllerConfig(**LENIENT | values))


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
        distances.append(robot.policy.error(robot.position, goal))
    reached = True
    for state, distance in zip(states, distances, strict=True):
        reached = distance < (0.075 if reached else 0.05)
        assert state is (State.REACHED if reached else State.ACTIVE)
    assert states.count(State.ACTIVE) > 10


@pytest.mark.parametrize(("moved", "state"), [(0.0049, State.REACHED), (0.0051, State.ACTIVE)])
def test_between_one_and_one_and_a_half_tolerances_it_stands_until_the_goal_moves_by_a_tenth(robot, moved, state):
    x, y = robot.tip()
    robot.tick(goal=Goal([x, y], "base"))
    while robot.policy.error(robot.position, [x, y]) < 0.06:
        robot.position[0] += 0.01
        assert is_stopped(robot.tick(goal=Goal([x, y], "base")), State.REACHED)
    for goal in ([x + moved, y], [x, y + moved]):
        if 0.055 < robot.policy.error(robot.position, goal) < 0.07:
            break
    assert robot.tick(goal=Goal(goal, "base")).state is state
    assert robot.controller.snapshot()["goal"] == goal


def test_a_hold_at_the_goal_ends_at_the_goal(robot):
    robot.tick(goal=Goal(robot.tip(), "base"))
    assert is_stopped(robot.ticks(7, state=None)[-1], State.HOLD)
    assert is_stopped(robot.ticks(5)[-1], State.REACHED)


# The snapshot.


def test_the_snapshot_is_plain_and_tells_state_reasons_and_counters(robot):
    snapshot = robot.controller.snapshot()
    assert snapshot["state"] == "waiting"
    assert snapshot["joint_state_age"] is None
    assert snapshot["command"] is None
    assert snapshot["goal"] is None
    assert snapshot["counters"] == {}
    robot.drive()
    robot.ticks(7, state=None)
    snapshot = json.loads(json.dumps(robot.controller.snapshot(), allow_nan=False))
    assert snapshot["state"] == "hold"
    assert snapshot["state_since"] == pytest.approx(robot.now - PERIOD)
    assert snapshot["reasons"] == ["the last joint state is 0.140 s old", "5 more good joint states are needed"]
    assert snapshot["last_hold"] == "the last joint state is 0.140 s old"
    assert snapshot["joint_state_age"] == pytest.approx(0.14)
    assert snapshot["recovery_states_needed"] == 5
    assert snapshot["goal"] == FAR_GOAL.value
    assert snapshot["command"] == [0.0, 0.0]
    assert snapshot["policy_sha256"] == robot.policy.sha256
    counters = snapshot["counters"]
    assert counters["updates"] == 28
    assert counters["states"] == 21
    assert counters["goals"] == 1
    assert counters["entered active"] == counters["entered hold"] == 1


def test_commands_can_be_compared_and_kept_in_sets(moving):
    command, other = moving.tick(), moving.tick()
    assert command != other
    assert len({command, other, command}) == 2


def test_what_it_gives_away_does_not_lead_back_inside(moving, policy):
    undisturbed = Robot(policy)
    undisturbed.drive()
    moving.tick().value[:] = 99.0
    undisturbed.tick()
    snapshot = moving.controller.snapshot()
    snapshot["goal"][0], snapshot["counters"]["updates"] = 99.0, -1
    assert moving.tick().value.tolist() == undisturbed.tick().value.tolist()
    assert moving.counters == undisturbed.counters


# All together, with the real policy and the real simulation.


@pytest.mark.slow
def test_it_brings_the_simulated_arm_to_at_least_9_of_10_goals_within_its_limits(policy, reacher):
    robots = 10
    simulation = Simulation(reacher, robots, seed=7)
    simulation.reset()
    # A stopwatch of its own: on a busy machine a policy now and then takes longer than its 10 ms.
    controllers = [Controller(policy, stopwatch=lambda: 0.0) for _ in range(robots)]
    limit = policy.metadata.position_limit
    reached, last = np.zeros(robots, dtype=bool), np.zeros((robots, 2))
    for tick in range(round(40 / PERIOD)):
        position = simulation.state.joint_position
        velocity = simulation.state.joint_velocity
        assert (position >= limit[:, 0]).all()
        assert (position <= limit[:, 1]).all()
        assert (np.abs(velocity) <= 0.3 * 1.05).all()
        commands = np.zeros((robots, 2))
        for row, controller in enumerate(controllers):
            state = JointState(NAMES, position[row], velocity[row], tick * PERIOD)
            goal = Goal(simulation.goal[row], "base") if tick == 0 else None
            command = controller.update(tick * PERIOD, state, goal)
            reached[row] |= command.state is State.REACHED
            commands[row] = command.value
        assert (np.abs(commands) <= 0.3 + 1e-9).all()
        assert (np.abs(commands - last)[commands != 0] <= 2.0 * PERIOD + 1e-9).all()
        last = commands
        simulation.step(commands / simulation.spec.command_limit)
        if reached.all():
            break
    simulation.close()
    assert reached.sum() >= 9
    for controller in controllers:
        assert set(controller.snapshot()["counters"]) <= {
            "updates",
            "states",
            "goals",
            "entered active",
            "entered reached",
            "ticks at a position limit",
        }
