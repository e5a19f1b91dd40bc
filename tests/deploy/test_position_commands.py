"""Commands that are positions: how the target moves, where it stands, and how far from the arm it may be."""

import math

import numpy as np
import pytest

from physai.deploy import Controller, ControllerConfig, Goal, JointState, State
from physai.deploy.interfaces import PositionInterface
from physai.deploy.limits import VelocityLimits
from tests.deploy.robot import FAR_GOAL, NAMES, PERIOD
from tests.deploy.troubled import Troubled

FIRST_STEP = 2.0 * PERIOD**2  # rad; what the acceleration limit lets a joint go in the first period


class Servo:
    """An arm of position drives, which are at their targets at the next period unless a test holds them."""

    def __init__(self, policy, position=(0.5, 1.0), **config):
        self.policy = Troubled(policy)
        self.controller = Controller(self.policy, ControllerConfig(**config), self.policy.stopwatch)
        self.now, self.position, self.held = 100.0, np.array(position), False
        self.target = self.position
        self.count = lambda position: position  # how the source counts

    def push(self, *velocity):
        self.policy.trouble = lambda command: np.array(velocity)

    def tick(self, goal=None, after=PERIOD, heard=True, **arguments):
        self.now += after
        speed = np.zeros(2)
        if not self.held:
            way = self.target - self.count(self.position)
            way = np.array([math.remainder(way[0], math.tau), way[1]])
            speed, self.position = way / PERIOD, self.position + way
        state = JointState(NAMES, self.count(self.position), np.clip(speed, -7, 7), self.now) if heard else None
        command = self.controller.update(self.now, state, goal, **arguments)
        if command.value is not None:
            self.target = command.value
        return command

    def ticks(self, count, **arguments):
        return [self.tick(**arguments) for _ in range(count)]

    def run(self, *velocity):
        """Until it moves at full speed."""
        self.push(*velocity)
        self.tick(FAR_GOAL)
        command = self.ticks(20)[-1]
        assert command.state is State.ACTIVE
        return command

    @property
    def counters(self):
        return self.controller.snapshot()["counters"]


@pytest.fixture
def servo(position_policy):
    return Servo(position_policy)


def stands(servo, state, position, count=10, **arguments):
    for command in servo.ticks(count, **arguments):
        assert command.state is state
        np.testing.assert_array_equal(command.value, position)
    return True


def test_the_policy_reaches_its_goals_by_positions(position_policy):
    for goal in ([0.0, 0.5], [-0.35, 0.1], [0.2, -0.3]):
        servo = Servo(position_policy)
        states = [servo.tick(Goal(goal, "base")).state, *(command.state for command in servo.ticks(1500))]
        assert State.REACHED in states
        assert set(states) <= {State.ACTIVE, State.REACHED}
        assert not [name for name in servo.counters if name.startswith(("commands", "faults", "holds"))]


def test_before_the_first_state_nothing_is_sent_also_in_an_emergency(servo):
    assert servo.tick(heard=False).value is None
    servo.controller.emergency_stop()
    assert servo.tick(heard=False).value is None
    assert stands(servo, State.ESTOP, [0.5, 1.0], heard=True)


def test_it_begins_where_the_arm_is_and_moves_on_within_velocity_and_acceleration(servo):
    servo.push(1.0, -2.0)
    first = servo.tick(FAR_GOAL)
    np.testing.assert_allclose(first.value - [0.5, 1.0], [FIRST_STEP / 2, -FIRST_STEP])
    values = np.array([first.value, *(command.value for command in servo.ticks(40))])
    speed = np.diff(values, axis=0) / PERIOD
    assert np.abs(speed).max() <= 0.3 + 1e-9
    assert np.abs(np.diff(speed, axis=0)).max() <= 2.0 * PERIOD + 1e-9
    np.testing.assert_allclose(speed[-1], [0.15, -0.3])  # in the direction that the policy wants


def test_what_the_policy_is_told_is_the_command_that_was_sent(servo):
    servo.run(0.2, 0.2)
    sent = servo.target
    servo.tick()
    np.testing.assert_allclose(servo.policy.inputs[3], sent, atol=1e-6)


def test_a_policy_at_its_fastest_is_not_beyond_its_range_by_rounding(position_policy):
    for angle in np.linspace(-3.1, 3.1, 9):
        servo = Servo(position_policy, (angle, 1.0))
        # As a file answers: in single precision.
        servo.policy.policy = lambda *inputs: (inputs[3] + np.float32(2.0 * PERIOD)).astype(np.float32)
        servo.policy.error = lambda position, goal: np.array([1.0])
        servo.tick(FAR_GOAL)
        servo.ticks(20)
        assert "commands clamped" not in servo.counters


def test_a_command_beyond_the_range_is_clamped_and_counted(servo):
    servo.run(50.0, 0.0)
    assert servo.counters["commands clamped"] == 21
    assert abs(servo.tick().value - servo.target).max() <= 0.3 * PERIOD + 1e-9


REASONS = {
    "emergency stop": (lambda servo: servo.controller.emergency_stop(), {}, State.ESTOP),
    "no permission": (lambda servo: None, {"interlocks": ["not enabled"]}, State.WAITING),
    "goal forgotten": (lambda servo: servo.controller.forget_goal(), {}, State.WAITING),
    "policy fails": (lambda servo: setattr(servo.policy, "trouble", "NaN"), {}, State.ACTIVE),
    "late": (lambda servo: None, {"after": 0.07}, State.ACTIVE),
}


@pytest.mark.parametrize(("cause", "arguments", "state"), REASONS.values(), ids=REASONS)
def test_whatever_stops_it_makes_it_hold_the_measured_position_at_once(servo, cause, arguments, state):
    servo.run(0.3, -0.3)
    servo.held = True  # its drives are late
    servo.ticks(3)
    assert np.abs(servo.target - servo.position).max() > 0.01
    cause(servo)
    command = servo.tick(**arguments)
    assert command.state is state
    np.testing.assert_array_equal(command.value, servo.position)


def test_while_it_stands_its_command_stays_though_the_arm_drifts(servo):
    servo.run(0.3, -0.3)
    servo.controller.emergency_stop()
    servo.tick()
    hold = servo.target.copy()
    servo.held = True
    for _ in range(20):
        servo.position = servo.position + 0.005
        assert stands(servo, State.ESTOP, hold, count=1)
    servo.controller.reset()
    servo.ticks(4)
    servo.push(0.3, 0.0)
    command = servo.tick(FAR_GOAL)
    assert command.state is State.ACTIVE
    np.testing.assert_allclose(command.value, servo.position + np.array([FIRST_STEP, 0.0]))  # from where it is now


def test_an_arm_that_was_moved_far_away_while_it_stood_does_not_leap_back(servo):
    servo.run(0.3, -0.3)
    servo.controller.emergency_stop()
    servo.tick()
    servo.held = True
    begun = servo.target.copy()
    for step in range(1, 6):
        servo.position = begun + np.array([0.049 * step, 0.0])
        assert stands(servo, State.ESTOP, begun, count=1)
    servo.position = begun + np.array([0.26, 0.0])
    assert stands(servo, State.ESTOP, servo.position)


def test_a_robot_that_was_away_and_is_back_elsewhere_is_not_sent_to_where_it_was(servo):
    servo.run(0.3, -0.3)
    servo.ticks(200, heard=False)
    servo.held, servo.position = True, np.array([-2.0, -1.0])
    servo.tick()
    assert stands(servo, State.HOLD, [-2.0, -1.0], count=3)


def test_a_reached_goal_is_held_where_the_arm_is(servo):
    servo.policy.error = lambda position, goal: np.array([0.01])
    servo.tick(FAR_GOAL)
    assert stands(servo, State.REACHED, [0.5, 1.0])


# How far ahead of the arm.


@pytest.mark.parametrize("lead", [0.02, 0.1])
def test_a_command_waits_for_an_arm_that_does_not_come_along(position_policy, lead):
    servo = Servo(position_policy, max_lead=lead, following_error=100.0, following_window=9.0)
    servo.held = True
    servo.run(0.3, -0.3)
    commands = servo.ticks(20)
    for command in commands:
        np.testing.assert_allclose(command.value, servo.position + np.array([lead, -lead]), atol=1e-9)
        assert command.reasons == (f"a command waits {lead:g} rad ahead of its joint",)
    assert servo.counters["ticks at max_lead"] >= 20
    servo.held = False  # and then goes on from rest
    speed = np.diff([command.value for command in servo.ticks(4)], axis=0) / PERIOD
    assert np.abs(speed).max() <= 0.3 + 1e-9


def test_a_drive_that_does_not_move_is_a_fault_before_its_command_is_far_away(servo):
    servo.held = True
    servo.push(0.3, -0.3)
    servo.tick(FAR_GOAL)
    command = servo.ticks(40)[-1]
    assert command.state is State.FAULT
    assert "is stuck" in command.reasons[-1]
    np.testing.assert_array_equal(command.value, servo.position)


def test_updates_that_are_not_on_time_are_no_arm_that_does_not_follow(position_policy):
    noise, servo = np.random.default_rng(3), Servo(position_policy)
    servo.push(0.3, -0.1)
    servo.tick(FAR_GOAL)
    for _ in range(250):
        assert servo.tick(after=noise.uniform(0.2, 2.9) * PERIOD).state is State.ACTIVE
    assert not [name for name in servo.counters if name.startswith(("faults", "holds"))]


# Position limits.


@pytest.mark.parametrize("sign", [1, -1])
def test_it_is_not_commanded_further_into_the_margin_though_the_arm_is_late(position_policy, sign):
    servo = Servo(position_policy, (0.0, sign * 2.4), following_error=100.0, following_window=9.0)
    servo.held = True
    servo.run(0.0, sign * 0.3)
    command = servo.ticks(20)[-1]
    assert 2.5 <= sign * command.value[1] <= 2.5 + 0.3 * PERIOD + 1e-9
    assert command.reasons == ("a joint is at its position limit: no motion outward",)


@pytest.mark.parametrize("sign", [1, -1])
def test_beyond_a_limit_it_is_commanded_slowly_inward_from_where_it_is(position_policy, sign):
    servo = Servo(position_policy, (0.0, sign * 2.65))
    servo.push(0.0, -sign * 1.0)
    values = [servo.tick(FAR_GOAL).value, *(command.value for command in servo.ticks(10))]
    assert sign * values[0][1] == pytest.approx(2.65 - FIRST_STEP, abs=1e-9)
    assert np.abs(np.diff(values, axis=0)).max() <= 0.05 * PERIOD + 1e-9


# Turns.


@pytest.mark.parametrize("sign", [1, -1])
def test_a_source_that_counts_from_half_a_turn_to_half_a_turn_is_commanded_as_it_counts(servo, sign):
    servo.count = lambda position: np.array([math.remainder(position[0], math.tau), position[1]])
    servo.position = servo.target = np.array([sign * 3.0, 1.0])
    servo.run(sign * 0.3, 0.0)
    for _ in range(100):
        command = servo.tick()
        assert command.state is State.ACTIVE
        assert command.reasons == ()
        ahead = command.value - servo.count(servo.position)
        np.testing.assert_allclose(ahead, [sign * 0.3 * PERIOD, 0.0], atol=1e-9)
    assert abs(servo.position[0]) > 3.5


@pytest.mark.parametrize("turns", [-7, -1, 0, 2])
def test_the_policy_sees_a_command_in_its_own_turn_and_the_robot_in_its(position_policy, turns):
    servo = Servo(position_policy, (0.5 + turns * math.tau, 1.0))
    servo.run(0.2, 0.0)
    np.testing.assert_allclose(servo.policy.inputs[3], servo.policy.inputs[0], atol=0.01)
    assert abs(servo.target[0] - servo.position[0]) < 0.01


# The interface alone.


def test_a_lower_velocity_holds_at_once(position_policy):
    metadata, config = position_policy.metadata, ControllerConfig()
    interface = PositionInterface(metadata)
    interface.configure(config, VelocityLimits(metadata, config))
    position = np.array([0.5, 1.0])
    interface.begin(position, position)
    interface.drive(np.array([0.3, -0.15]), PERIOD)
    slower = ControllerConfig(max_velocity=0.1)
    interface.configure(slower, VelocityLimits(metadata, slower))
    np.testing.assert_allclose(interface.velocity, [0.1, -0.05])


def test_what_it_gives_away_does_not_lead_back_inside(servo):
    servo.run(0.3, 0.0)
    expected = servo.target + np.array([0.3 * PERIOD, 0.0])
    servo.target = servo.target.copy()
    servo.controller.snapshot()["command"][0] = 99.0
    command = servo.tick()
    np.testing.assert_allclose(command.value, expected, atol=1e-9)
    servo.controller.emergency_stop()
    hold = servo.tick().value
    kept = hold.copy()
    hold[:] = 99.0
    servo.target = kept
    assert stands(servo, State.ESTOP, kept)
