"""Rows of the table of faults: an arm that does not do what it is told, and sensors that contradict themselves."""

import math
from collections import deque
from itertools import count

import numpy as np
import pytest
import torch

from physai.deploy import Controller, ControllerConfig, Goal, JointState, State
from physai.deploy.following import Following
from physai.physics import ParameterLayout, RobotState
from physai.physics.pybullet import PyBulletPhysics
from physai.robots import RobotSpec
from tests import composed
from tests.deploy.troubled import Troubled

PERIOD = 0.02
NAMES = ("joint1", "joint2")
FAR_GOAL = Goal([-0.4, -0.1], "base")
WITHIN = 0.6  # s


class Arm:
    """An arm under a controller; by default it does what it is told, a little late.

    Attributes:
        obey: What the drives make of a command.
        show: What the sensors make of a message's values.
        drive: What the policy wants instead; None: what it wants.
    """

    def __init__(self, policy, position=(0.5, 1.0), delay=0, **config):
        self.policy = Troubled(policy)
        self.controller = Controller(self.policy, ControllerConfig(**config), self.policy.stopwatch)
        self.now, self.position = 100.0, np.array(position)
        self.obey = lambda velocity: velocity
        self.show = lambda **values: values
        self.commands = deque([np.zeros(2)] * (delay + 1), maxlen=delay + 1)

    def push(self, *velocity):
        self.policy.trouble = lambda command: np.array(velocity)

    def tick(self, goal=None, interlocks=()):
        self.now += PERIOD
        velocity = self.obey(self.commands[0])
        self.position = self.position + velocity * PERIOD
        values = self.show(names=NAMES, position=self.position, velocity=velocity, stamp=self.now)
        command = self.controller.update(self.now, JointState(**values), goal, interlocks)
        self.commands.append(np.zeros(2) if command.value is None else command.value)
        return command

    def run(self, seconds, goal=None):
        commands = [self.tick(goal)]
        while len(commands) < seconds / PERIOD:
            commands.append(self.tick())
        return commands

    def fault(self, goal=FAR_GOAL):
        """Drive until a fault; return how long it took from the first command on, and what was said."""
        commands = self.run(2.0, goal)
        began = next(tick for tick, command in enumerate(commands) if command.value is not None)
        assert commands[-1].state is State.FAULT, commands[-1]
        assert commands[-1].value.tolist() == [0.0, 0.0]
        return next(t for t, c in enumerate(commands) if c.state is State.FAULT) * PERIOD - began * PERIOD, (
            commands[-1].reasons[-1]
        )

    @property
    def counters(self):
        return self.controller.snapshot()["counters"]


def one(joint, value):
    """A function of a vector that gives another value to one joint."""
    return lambda vector: np.where(np.arange(2) == joint, value(vector), vector)


BROKEN = {
    "off": (one, lambda vector: 0 * vector, "does not move"),
    "wrong sign": (one, lambda vector: -vector, "moves the other way"),
    "slower than half": (one, lambda vector: 0.45 * vector, "moves too slowly"),
}


def poses(count):
    draw = np.random.default_rng(5)
    return np.stack([draw.uniform(-9, 9, count), draw.uniform(-2.2, 2.2, count)], axis=1)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize(("of", "change", "how"), BROKEN.values(), ids=BROKEN)
@pytest.mark.fault("an arm that does not do what it is told (`following_error`, see below)")
def test_a_drive_that_does_not_do_what_it_is_told_is_a_fault_that_says_how(policy, of, change, how, joint):
    noise = np.random.default_rng(3)
    for pose in poses(10):
        arm = Arm(policy, pose)
        push = 0.4 * noise.standard_normal(2)
        push[joint] = -math.copysign(2.0, pose[joint])
        arm.push(*push)
        arm.obey = of(joint, change)
        arm.show = lambda position, **values: values | {"position": position + 1e-4 * noise.standard_normal(2)}
        took, reason = arm.fault()
        assert took <= WITHIN
        assert reason.startswith(f"'{NAMES[joint]}' {how}: by "), reason
        assert arm.counters["faults: following"] == 1


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("moving", [False, True], ids=["from the start", "while it moves"])
@pytest.mark.fault("an arm that does not do what it is told (`following_error`, see below)")
def test_an_encoder_that_is_stuck_is_a_fault_though_its_stamps_are_fresh(policy, joint, moving):
    for pose in poses(10):
        arm = Arm(policy, pose)
        arm.push(*(-math.copysign(2.0, q) * (1.0 if j == joint else 0.3) for j, q in enumerate(pose)))
        goal = FAR_GOAL
        if moving:
            assert arm.run(0.6, FAR_GOAL)[-1].state is State.ACTIVE
            goal = None
        stuck, velocity = arm.position[joint], arm.commands[0][joint]
        arm.show = lambda position, velocity, stuck=stuck, speed=velocity, **values: (
            values
            | {
                "position": np.where(np.arange(2) == joint, stuck, position),
                "velocity": np.where(np.arange(2) == joint, speed, velocity),
            }
        )
        took, reason = arm.fault(goal)
        assert took <= WITHIN
        assert reason.startswith(f"'{NAMES[joint]}' ")
        assert moving or "is stuck" in reason


def test_a_joint_that_moves_by_itself_is_a_fault(policy):
    arm = Arm(policy)
    arm.push(0.0, 0.0)
    arm.run(0.5, FAR_GOAL)
    arm.obey = lambda velocity: velocity + np.array([0.0, 0.2])
    took, reason = arm.fault(None)
    assert took <= WITHIN
    assert "'joint2' moves by itself" in reason


def test_after_such_a_fault_a_reset_and_a_new_goal_start_anew(policy):
    arm = Arm(policy)
    arm.obey = lambda velocity: 0 * velocity
    arm.fault()
    arm.obey = lambda velocity: velocity
    arm.controller.reset()
    arm.run(0.2)
    commands = arm.run(2.0, FAR_GOAL)
    assert {command.state for command in commands} == {State.ACTIVE}


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 3, 8], ids=["at once", "60 ms", "160 ms"])
@pytest.mark.parametrize("speed", [0.1, 0.3, 1.0])
def test_an_arm_that_follows_late_and_noisily_is_no_fault(policy, speed, delay):
    noise = np.random.default_rng(7)
    arm = Arm(policy, delay=delay, max_velocity=speed, limit_margin=max(0.1, 0.17 * speed))
    arm.show = lambda position, velocity, **values: (
        values
        | {
            "position": position + 0.002 * noise.standard_normal(2),
            "velocity": velocity + 0.05 * noise.standard_normal(2),
        }
    )
    for _ in range(12):
        angle, radius = noise.uniform(-3.1, 3.1), noise.uniform(0.31, 0.52)
        commands = arm.run(4.0, Goal([radius * math.cos(angle), radius * math.sin(angle)], "base"))
        assert {command.state for command in commands} <= {State.ACTIVE, State.REACHED}


def test_an_arm_that_follows_late_may_turn_round_when_it_has_hardly_rested(policy):
    """It still does what it was told before it was at its goal."""
    following, late = Following(policy.metadata, ControllerConfig()), deque([0.0] * 8)
    position = 0.0
    for step in range(100):
        resting = 50 <= step < 52
        speed = 0.0 if resting else -1.0 if step < 50 else 0.2
        following.commanded(0.02 * step, np.full(2, 0.02 * speed), rests=resting)
        late.append(speed)
        position += 0.02 * (moving := late.popleft())
        assert following.heard(0.02 * step + 0.001, np.array([position] * 2 + [moving] * 2)) is None


def test_an_arm_that_follows_is_no_fault_though_every_second_state_is_refused(policy):
    arm, states = Arm(policy), count()
    arm.show = lambda velocity, **values: values | {"velocity": velocity if next(states) % 2 else (math.nan, 0.0)}
    assert {command.state for command in arm.run(4.0, FAR_GOAL)[1:]} == {State.ACTIVE}
    assert arm.counters["states rejected: velocity missing"] == 100


@pytest.mark.parametrize("every", [2, 3, 4])
@pytest.mark.parametrize("age", [0.0, 0.01])
def test_states_that_come_seldom_and_not_on_time_are_measured_at_their_own_time(policy, every, age):
    following = Following(policy.metadata, ControllerConfig(following_error=0.05, velocity_error=0.01))
    speed = np.array([2.0, -0.5])
    for tick in range(100):
        now = tick * PERIOD
        following.commanded(now, speed * PERIOD)
        if tick % every == every - 1:
            motion = np.concatenate([speed * (now - age), speed])
            assert following.heard(now - age, motion) is None


def test_what_happens_to_an_arm_that_is_not_driven_is_no_fault(policy):
    arm = Arm(policy)
    for interlocks in (("not enabled",), ()):  # without a goal, too
        for _ in range(50):
            arm.position = arm.position + 0.005
            assert arm.tick(interlocks=interlocks).state is State.WAITING


def test_a_share_of_one_lets_a_weak_drive_pass_and_is_taken_while_it_runs(policy):
    arm = Arm(policy)
    arm.obey = lambda velocity: 0.45 * velocity
    arm.controller.configure(ControllerConfig(following_error=1.0))
    assert {command.state for command in arm.run(2.0, FAR_GOAL)} == {State.ACTIVE}
    arm.controller.configure(ControllerConfig())
    assert arm.run(1.0)[-1].state is State.FAULT


# Sensors that contradict themselves.


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("change", [lambda v: -v, lambda v: v * 180 / math.pi / 10, lambda v: v + 0.5])
@pytest.mark.fault("reported velocities contradict the way that the positions went (`velocity_error`)")
def test_velocities_that_contradict_positions_are_refused_and_hold(policy, joint, change):
    arm = Arm(policy)
    arm.push(2.0, 2.0)
    arm.show = lambda velocity, **values: values | {"velocity": one(joint, change)(velocity)}
    commands = arm.run(0.6, FAR_GOAL)
    held = next(command for command in commands if command.state is State.HOLD)
    assert held.value.tolist() == [0.0, 0.0]
    assert held.reasons[0].startswith(f"joint state rejected: '{NAMES[joint]}' reports velocities for ")
    assert arm.counters["states rejected: velocity inconsistent"] == 1


# Progress.


@pytest.mark.fault("distance to the goal has not fallen for `progress_timeout` (10 s)")
def test_a_goal_that_comes_no_nearer_is_given_up_until_another_comes(policy):
    arm = Arm(policy, progress_timeout=1.0)
    arm.push(0.0, 0.0)
    commands = arm.run(1.5, FAR_GOAL)
    assert [command.state for command in commands].index(State.HOLD) * PERIOD == pytest.approx(1.02, abs=PERIOD)
    assert commands[-1].reasons == (commands[-1].reasons[0],)
    assert commands[-1].reasons[0].startswith("no progress for 1 s, 0.")
    assert arm.counters["holds: no progress"] == 1
    assert arm.run(0.5, FAR_GOAL)[-1].state is State.HOLD  # the same one
    arm.policy.trouble = None
    assert arm.run(0.5, Goal([0.0, -0.4], "base"))[-1].state is State.ACTIVE


def test_a_goal_that_was_given_up_is_forgotten_by_a_reset(policy):
    arm = Arm(policy, progress_timeout=0.5)
    arm.push(0.0, 0.0)
    assert arm.run(1.0, FAR_GOAL)[-1].state is State.HOLD
    arm.controller.reset()
    assert arm.run(0.2)[-1].reasons == ("no goal yet",)
    arm.policy.trouble = None
    assert arm.run(0.5, FAR_GOAL)[-1].state is State.ACTIVE


def test_slow_progress_is_progress(policy):
    arm = Arm(policy, max_velocity=0.02, progress_timeout=3.0)
    assert {command.state for command in arm.run(20.0, FAR_GOAL)} == {State.ACTIVE}


# Effort.


@pytest.mark.fault("effort beyond its limit for `effort_time` (0.5 s), where the state tells it")
def test_an_effort_beyond_its_limit_for_a_while_is_a_fault(policy):
    arm = Arm(policy)
    arm.run(0.5, FAR_GOAL)
    arm.show = lambda **values: values | {"effort": (math.nan, -3.5)}  # of 5 and 3 N·m
    assert {command.state for command in arm.run(0.48)} == {State.ACTIVE}
    command = arm.run(0.06)[-1]
    assert command.state is State.FAULT
    assert command.reasons[-1].startswith("'joint2' takes -3.5 N·m, beyond its 3, for 0.5")
    assert arm.counters["faults: effort"] == 1


def test_an_effort_within_its_limit_or_beyond_it_for_moments_is_none(policy):
    arm = Arm(policy)
    arm.run(0.1, FAR_GOAL)
    for effort, seconds in ((5.5, 0.4), (4.9, 0.02), (5.5, 0.4), (math.nan, 0.02), (4.9, 2.0)):
        arm.show = lambda effort=effort, **values: values | {"effort": (effort, 0.0)}
        assert {command.state for command in arm.run(seconds)} == {State.ACTIVE}


# The same with the real simulation.


def simulate(policy, reacher, robots, seconds, randomization, seed, change=None):
    """Let simulated robots pursue goal after goal; return their controllers."""
    spec = RobotSpec.from_config(reacher.robot)
    layout = ParameterLayout(spec)
    draws = composed.randomization(randomization)
    rows = draws.sample(robots, layout, torch.Generator().manual_seed(seed)).numpy()
    dynamics, draw = layout.dynamics(rows), np.random.default_rng(seed)
    offset, shaky, jerky, delay = (
        rows[:, layout.columns[name]].astype(float)
        for name in ("encoder_offset", "position_noise", "velocity_noise", "actuator_delay")
    )
    start = np.stack([draw.uniform(-3, 3, robots), draw.uniform(-2.2, 2.2, robots)], axis=1)
    if change is not None:
        change(dynamics)
    physics = PyBulletPhysics(spec, robots, PERIOD / 2)
    physics.reset(np.arange(robots), RobotState(start, np.zeros((robots, 2))), dynamics)
    controllers = [Controller(policy, stopwatch=lambda: 0.0) for _ in range(robots)]
    sent, late = np.zeros((7, robots, 2)), np.round(2 * delay[:, 0]).astype(int)
    for tick in range(round(seconds / PERIOD)):
        state = physics.robot_state()
        position, velocity = state.joint_position, state.joint_velocity
        position = position + offset + shaky * draw.standard_normal((robots, 2))
        velocity = velocity + jerky * draw.standard_normal((robots, 2))
        commands = np.zeros((robots, 2))
        for row, controller in enumerate(controllers):
            goal = None
            if not tick or (controller.snapshot()["state"] == "reached" and draw.random() < 0.05):
                angle, radius = draw.uniform(-3.1, 3.1), draw.uniform(0.31, 0.52)
                goal = Goal([radius * math.cos(angle), radius * math.sin(angle)], "base")
            state = JointState(NAMES, position[row].tolist(), velocity[row].tolist(), tick * PERIOD)
            commands[row] = controller.update(tick * PERIOD, state, goal).value
        for _ in range(2):
            sent = np.concatenate([commands[None], sent[:-1]])
            physics.step(sent[late, np.arange(robots)])
    physics.close()
    return controllers


@pytest.mark.slow
def test_no_robot_of_strong_randomization_is_said_not_to_follow(policy, reacher):
    for controller in simulate(policy, reacher, 25, 15.0, "strong", seed=21):
        counters = controller.snapshot()["counters"]
        assert counters["entered active"] >= 1
        assert not [name for name in counters if name.startswith(("faults", "holds", "states rejected"))], counters


def test_a_payload_beyond_the_drives_is_a_fault(policy, reacher):
    def load(dynamics):
        dynamics["payload"][:] = 500.0  # kg, on drives of 5 and 3 N·m

    found = [controller.snapshot() for controller in simulate(policy, reacher, 10, 1.0, "none", seed=22, change=load)]
    faults = [each["counters"]["faults: following"] for each in found if each["state"] == "fault"]
    assert len(faults) >= 8  # one that begins near its goal is asked for next to nothing
    assert set(faults) == {1}
