"""Rows of the table of faults: a robot that tells of its joints in parts, goes silent, or is another one."""

import math

import numpy as np
import pytest

from physai.deploy import Controller, ControllerConfig, Goal, JointState, State
from tests.deploy.robot import FAR_GOAL, LENIENT, Robot, is_stopped
from tests.deploy.troubled import Troubled

PERIOD = 0.02
NAMES = ("joint1", "joint2")


class Arm:
    """An arm that does what it is told, and tells of its joints as a test likes."""

    def __init__(self, policy, position=(0.5, 1.0), **config):
        self.policy = Troubled(policy)
        self.controller = Controller(self.policy, ControllerConfig(**config), self.policy.stopwatch)
        self.now, self.ticks = 100.0, 0
        self.position, self.velocity = np.array(position), np.zeros(2)
        self.source = None

    def message(self, *names):
        where = dict(zip(NAMES, zip(self.position.tolist(), self.velocity.tolist(), strict=True), strict=True))
        position, velocity = zip(*(where.get(name, (math.nan, math.nan)) for name in names), strict=True)
        return JointState(names, position, velocity, self.now, source=self.source)

    def move(self):
        self.now, self.ticks = self.now + PERIOD, self.ticks + 1
        self.position = self.position + self.velocity * PERIOD

    def tick(self, *messages, goal=None):
        """A period passes; then come messages of joints with these names, or all joints in one."""
        self.move()
        states = [self.message(*names) for names in messages or [NAMES]]
        return self.send(states if messages else states[0], goal)

    def send(self, states, goal=None):
        command = self.controller.update(self.now, states, goal)
        self.velocity = np.zeros(2) if command.value is None else command.value
        return command

    def run(self, seconds, *messages, goal=None):
        commands = [self.tick(*messages, goal=goal)]
        while len(commands) < seconds / PERIOD:
            commands.append(self.tick(*messages))
        return commands

    def silent(self, seconds):
        for _ in range(round(seconds / PERIOD)):
            self.move()
            command = self.send(None)
        return command

    @property
    def counters(self):
        return self.controller.snapshot()["counters"]


# Row: something else on the same topic.


@pytest.mark.parametrize("rate", [50, 200, 1000])
@pytest.mark.parametrize("first", [True, False], ids=["before", "after"])
@pytest.mark.fault("a message that names none of the policy's joints, such as a gripper's")
def test_a_gripper_beside_the_arm_neither_restarts_a_recovery_nor_counts_as_refused(policy, rate, first):
    arm, fingers = Arm(policy), [("finger", "thumb")] * (rate // 50)
    messages = [*fingers, NAMES] if first else [NAMES, *fingers]
    assert arm.run(1.0, *messages, goal=FAR_GOAL)[-1].state is State.ACTIVE
    assert is_stopped(arm.silent(0.2), State.HOLD)
    before = arm.counters["states of other joints"]
    for left in (4, 3, 2, 1):
        command = arm.tick(*messages)
        assert is_stopped(command, State.HOLD)
        assert command.reasons == (f"{left} more good joint states are needed",)
    assert arm.tick(*messages).state is State.ACTIVE
    assert arm.counters["states of other joints"] == before + 5 * rate // 50
    assert not [name for name in arm.counters if "rejected" in name]


def test_a_gripper_alone_does_not_keep_a_silent_arm_alive(policy):
    arm = Arm(policy)
    arm.run(1.0, goal=FAR_GOAL)
    commands = arm.run(0.2, ("finger", "thumb"))
    assert is_stopped(commands[-1], State.HOLD)
    assert commands[-1].reasons[0] == "the last joint state is 0.200 s old"
    assert recovered_after(arm, 5)


def recovered_after(arm, ticks, *messages):
    """It starts again after exactly so many updates."""
    states = [arm.tick(*messages).state for _ in range(ticks)]
    assert states == [State.HOLD] * (ticks - 1) + [State.ACTIVE]
    return True


# Row: a message for each joint.

GOALS = [Goal([0.0, 0.5], "base"), Goal([-0.35, 0.1], "base"), Goal([0.2, -0.3], "base")]


def pursue(arm, goal, tell):
    """Return how long it took to reach a goal."""
    command = arm.tick(*tell(arm), goal=goal)
    for tick in range(1500):
        if command.state is State.REACHED:
            return tick * PERIOD
        assert command.state is State.ACTIVE, command
        command = arm.tick(*tell(arm))
    raise AssertionError(command)


@pytest.mark.parametrize(
    "tell",
    [
        lambda arm: [NAMES[:1], NAMES[1:]],
        lambda arm: [NAMES[arm.ticks % 2 :][:1]],
        lambda arm: [("joint2", "finger"), ("finger", "joint1")],
        lambda arm: [NAMES[:1], NAMES[1:]] if arm.ticks % 2 else [NAMES],
    ],
    ids=["both at once", "in turn", "with a finger", "now and then whole"],
)
@pytest.mark.slow
@pytest.mark.fault("messages that name some of the joints")
def test_an_arm_that_tells_of_its_joints_in_parts_reaches_its_goals_as_one_that_does_not(policy, tell):
    parts, whole = Arm(policy), Arm(policy)
    for arm in (parts, whole):
        arm.tick(NAMES[:1], NAMES[1:])
    for goal in GOALS:
        took, usual = pursue(parts, goal, tell), pursue(whole, goal, lambda arm: [NAMES])
        assert took == pytest.approx(usual, abs=0.1)
    assert not [name for name in parts.counters if name.startswith(("holds", "faults", "states rejected"))]


@pytest.mark.parametrize("joint", [0, 1])
def test_one_joint_of_two_that_goes_silent_holds_and_is_named(policy, joint):
    arm = Arm(policy)
    arm.run(1.0, goal=FAR_GOAL)
    commands = arm.run(0.12, (NAMES[1 - joint],))
    assert [command.state for command in commands] == [State.ACTIVE] * 5 + [State.HOLD]
    assert is_stopped(commands[-1], State.HOLD)
    assert commands[-1].reasons[0] == f"the last state of '{NAMES[joint]}' is 0.120 s old"
    assert arm.counters["holds: state old"] == 1
    assert is_stopped(arm.run(0.3, (NAMES[1 - joint],))[-1], State.HOLD)
    assert recovered_after(arm, 5)


@pytest.mark.parametrize("joint", [0, 1])
def test_before_all_joints_are_known_it_waits_sends_nothing_and_says_which_is_missing(policy, joint):
    arm = Arm(policy)
    for command in arm.run(0.5, (NAMES[joint],), goal=FAR_GOAL):
        assert command.value is None
        assert command.state is State.WAITING
        assert command.reasons == (f"no state of '{NAMES[1 - joint]}' yet",)
    assert arm.tick(NAMES[1 - joint :][:1]).state is State.ACTIVE


def test_an_arm_of_which_one_joint_is_known_to_be_far_beyond_its_limit_is_a_fault(policy):
    arm = Arm(policy, (0.5, 2.9))
    command = arm.tick(NAMES[1:])
    assert is_stopped(command, State.FAULT)
    assert command.reasons == ("'joint2' is far beyond its position limit, at 2.900 rad",)


def test_a_recovery_counts_rounds_of_all_joints(policy):
    arm = Arm(policy)
    arm.run(1.0, goal=FAR_GOAL)
    arm.silent(0.2)
    for _ in range(3):
        assert is_stopped(arm.tick(NAMES[:1]), State.HOLD)  # however often the one comes
    for tick, needed in enumerate((4, 4, 3, 3, 2, 2, 1, 1)):
        assert is_stopped(arm.tick((NAMES[1 - tick % 2],)), State.HOLD)
        assert arm.controller.snapshot()["recovery_states_needed"] == needed
    assert arm.tick(NAMES[1:]).state is State.ACTIVE


def test_a_bad_message_of_one_joint_starts_the_rounds_anew(policy):
    arm = Arm(policy)
    arm.run(1.0, goal=FAR_GOAL)
    arm.silent(0.2)
    arm.run(4 * PERIOD, NAMES[:1], NAMES[1:])
    assert arm.controller.snapshot()["recovery_states_needed"] == 1
    arm.move()
    arm.send([arm.message("joint1"), JointState(("joint2",), (math.nan,), (0.0,), arm.now)])
    assert recovered_after(arm, 5, NAMES[:1], NAMES[1:])


# Row: a robot that was away.


@pytest.mark.fault("robot silent for longer than `resume_timeout` (1 s), or told by another source than before")
def test_a_robot_that_was_silent_for_3_s_and_is_back_elsewhere_does_not_move_before_a_new_goal(policy):
    arm = Arm(policy)
    arm.run(1.0, goal=FAR_GOAL)
    assert is_stopped(arm.silent(3.0), State.HOLD)
    arm.position = np.array([-2.0, -1.0])
    command = arm.tick()
    assert is_stopped(command, State.HOLD)
    assert command.reasons[0] == "goal forgotten: the robot was silent for 3.0 s"
    assert arm.counters["goals forgotten: silent"] == 1
    commands = arm.run(2.0)
    assert not any(command.value.any() for command in commands)
    assert commands[-1].reasons == ("no goal yet",)
    assert arm.tick(goal=FAR_GOAL).state is State.ACTIVE


def test_of_one_joint_that_was_silent_the_goal_is_forgotten_too(policy):
    arm = Arm(policy)
    arm.run(1.0, goal=FAR_GOAL)
    assert is_stopped(arm.run(2.0, NAMES[:1])[-1], State.HOLD)
    assert arm.tick(NAMES[1:]).reasons[0] == "goal forgotten: the robot was silent for 2.0 s"
    assert is_stopped(arm.run(1.0)[-1], State.WAITING)


@pytest.mark.parametrize("gap", [0.2, 0.5, 0.9])
def test_after_a_shorter_gap_it_drives_on_to_its_goal(policy, gap):
    arm = Arm(policy)
    arm.run(1.0, goal=FAR_GOAL)
    assert is_stopped(arm.silent(gap), State.HOLD)
    assert recovered_after(arm, 5)
    assert not [name for name in arm.counters if name.startswith("goals forgotten")]


@pytest.mark.parametrize("messages", [[], [NAMES[:1], NAMES[1:]]], ids=["whole", "in parts"])
@pytest.mark.fault("robot silent for longer than `resume_timeout` (1 s), or told by another source than before")
def test_another_source_of_joint_states_forgets_the_goal(policy, messages):
    arm = Arm(policy)
    arm.source = "driver"
    arm.run(1.0, *messages, goal=FAR_GOAL)
    arm.source = "another driver"
    command = arm.tick(*messages)
    assert is_stopped(command, State.HOLD)
    assert command.reasons[0].startswith("goal forgotten: 'joint")
    assert command.reasons[0].endswith("' is told by another source than before")
    assert arm.counters["goals forgotten: another source"] == arm.counters["holds: another source"] == 1
    commands = arm.run(1.0, *messages)
    assert not any(command.value.any() for command in commands)
    assert is_stopped(commands[-1], State.WAITING)
    assert arm.tick(*messages, goal=FAR_GOAL).state is State.ACTIVE


def test_two_sources_each_of_a_joint_of_its_own_are_one_robot(policy):
    arm = Arm(policy)
    arm.tick(goal=FAR_GOAL)
    for _ in range(50):
        arm.move()
        states = []
        for arm.source, joint in (("shoulder", "joint1"), ("elbow", "joint2")):
            states.append(arm.message(joint))
        assert arm.send(states).state is State.ACTIVE


# Row: limits.


@pytest.mark.parametrize("state", [State.ACTIVE, State.WAITING])
def test_a_lower_limit_fault_holds_at_the_next_update_though_no_new_state_comes(policy, state):
    robot = Robot(policy)
    robot.position = [0.5, 2.75]
    assert robot.tick(goal=FAR_GOAL if state is State.ACTIVE else None).state is state
    robot.controller.configure(ControllerConfig(**LENIENT, limit_fault=0.1))
    command = robot.tick(state=None)
    assert is_stopped(command, State.FAULT)
    assert command.reasons == ("'joint2' is far beyond its position limit, at 2.750 rad",)
    robot.controller.configure(ControllerConfig(**LENIENT))
    assert is_stopped(robot.tick(), State.FAULT)  # until a reset
    robot.controller.reset()
    assert is_stopped(robot.ticks(5)[-1], State.WAITING)


@pytest.mark.parametrize("acceleration", [0.1, 2.0])
def test_beyond_a_limit_it_is_slow_at_once_and_keeps_its_direction_however_little_it_may_decelerate(
    policy, acceleration
):
    robot = Robot(policy, max_velocity=1.0, limit_margin=0.165, max_acceleration=acceleration)
    robot.policy.trouble = lambda command: np.array([2.0, -1.0])
    robot.position = [0.0, 2.59]
    robot.tick(goal=FAR_GOAL)
    before = robot.ticks(300)[-1].value
    np.testing.assert_allclose(
        before, [0.6 if acceleration < 1 else 1.0, -0.3 if acceleration < 1 else -0.5], rtol=0.01
    )
    robot.position = [0.0, 2.61]
    for command in robot.ticks(20):
        np.testing.assert_allclose(command.value, [0.05, -0.025], rtol=1e-6)
        assert command.reasons[-1] == "a joint is beyond its position limit: slow"


# Row: a continuous joint after many turns.


@pytest.mark.parametrize("turns", [-(10**6), 10**6])
def test_after_a_million_turns_it_reaches_its_goals(policy, turns):
    arm = Arm(policy, (0.5 + 2 * math.pi * turns, 1.0))
    arm.tick()
    for goal in GOALS:
        assert pursue(arm, goal, lambda arm: [NAMES]) < 20.0
    assert not [name for name in arm.counters if name.startswith(("holds", "faults", "states rejected"))]
