"""Policies that remember, on a robot: what is loaded, what is refused, and when the controller begins anew."""

import math

import numpy as np
import pytest

from physai.deploy import Controller, ControllerConfig, Goal, JointState, State, load_policy
from physai.deploy.metadata import describe_signal
from physai.signals import Quantity, Signal
from tests.deploy.files import described, refusal

PERIOD, SIZE = 0.02, 40
GOAL, OTHER_GOAL = Goal([-0.4, -0.1], "base"), Goal([-0.1, -0.4], "base")


@pytest.fixture(scope="session")
def recurrent(recurrent_run):
    return load_policy(recurrent_run / "policy.pt")


@pytest.fixture(scope="session")
def recurrent_content(recurrent_run):
    return (recurrent_run / "policy.pt").read_bytes()


def test_a_policy_that_remembers_takes_and_gives_a_memory(recurrent, policy):
    command, memory = recurrent([0.1, 0.2], [0.0, 0.0], [0.4, 0.0], np.zeros(SIZE))
    assert (command.shape, command.dtype, memory.shape, memory.dtype) == ((2,), np.float32, (SIZE,), np.float32)
    kept = memory.copy()
    other, _ = recurrent([0.1, 0.2], [0.0, 0.0], [0.4, 0.0], memory)
    assert not np.array_equal(command, other)
    assert np.array_equal(memory, kept)  # it keeps nothing itself, and writes to nothing
    for wrong in ((), (np.zeros(SIZE - 1),), (np.zeros((1, SIZE)),), (0.0,)):
        with pytest.raises((TypeError, ValueError)):
            recurrent([0.1, 0.2], [0.0, 0.0], [0.4, 0.0], *wrong)
    with pytest.raises(ValueError, match="3 inputs are needed, not 4"):
        policy([0.1, 0.2], [0.0, 0.0], [0.4, 0.0], [0.0])
    assert policy.metadata.memory_size == 0


def test_in_torchrl_code_it_has_its_keys(recurrent):
    module = recurrent.as_tensordict_module()
    assert module.in_keys == ["joint_position", "joint_velocity", "goal", "memory"]
    assert module.out_keys == ["joint_velocity_command", "new_memory"]


def set_size(size):
    def edit(metadata):
        for side in ("inputs", "outputs"):
            metadata[side][-1]["shape"] = size

    return edit


def forget_the_output(metadata):
    metadata["outputs"].pop()


def forget_the_memory(metadata):
    for side in ("inputs", "outputs"):
        metadata[side].pop()


def other_golden_memory(key):
    def edit(metadata):
        metadata["golden"][key][3][5] += 1e-2

    return edit


def golden_nan(metadata):
    metadata["golden"]["new_memory"][0][0] = None


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (set_size([0]), "inputs.3.shape must be positive integers"),
        (set_size([True]), "inputs.3.shape must be positive integers"),
        (set_size([10**9]), "inputs.3.shape must be positive integers"),
        (set_size([60000, 60000]), "inputs.3 has 3,600,000,000 numbers, more than 65,536"),
        (set_size(40), "inputs.3.shape must be a list"),
        (set_size([39]), "golden.memory must have the shape [32, 39], not [32, 40]"),
        (forget_the_output, "there is 'memory' among the inputs, and no 'new_memory' among the outputs"),
        (lambda metadata: metadata["inputs"].pop(), "a policy that remembers takes 'memory' and gives as much"),
        (forget_the_memory, "its forward takes ['joint_position', 'joint_velocity', 'goal', 'memory'], not"),
        (lambda metadata: metadata["golden"].pop("memory"), "golden.memory is missing"),
        (golden_nan, "golden.new_memory must be finite"),
        (other_golden_memory("memory"), "a golden pair differs by"),
        (other_golden_memory("new_memory"), "the new_memory of a golden pair differs by 0.01"),
    ],
)
def test_metadata_that_do_not_fit_its_memory_are_refused(recurrent_content, path, edit, message):
    path.write_bytes(described(recurrent_content, edit))
    assert message in refusal(path)


def test_a_policy_without_memory_that_claims_one_is_refused(content, path):
    def claim(metadata):
        for side, name in (("inputs", "memory"), ("outputs", "new_memory")):
            metadata[side].append(describe_signal(Signal(name, Quantity.MEMORY, (1,))))
        pairs = len(metadata["golden"]["goal"])
        metadata["golden"] |= {"memory": [[0.0]] * pairs, "new_memory": [[0.0]] * pairs}

    path.write_bytes(described(content, claim))
    assert "its forward takes ['joint_position', 'joint_velocity', 'goal'], not" in refusal(path)


class Recorder:
    """The policy, what it was told, and trouble on demand: a function of command and new memory."""

    def __init__(self, policy):
        self.policy, self.metadata, self.sha256 = policy, policy.metadata, policy.sha256
        self.error, self.given, self.trouble = policy.error, [], None

    def __call__(self, joint_position, joint_velocity, goal, memory):
        self.given.append(np.array(memory))
        answer = self.policy(joint_position, joint_velocity, goal, memory)
        return answer if self.trouble is None else self.trouble(*answer)


class Robot:
    """A controller, and an arm that stays where it is."""

    def __init__(self, policy, **config):
        self.policy, self.now = Recorder(policy), 100.0
        self.controller = Controller(self.policy, ControllerConfig(**config), stopwatch=lambda: 0.0)
        self.position = [0.5, 1.0]

    def tick(self, after=PERIOD, goal=None, interlocks=(), **state):
        self.now += after
        joints = {"names": ("joint1", "joint2"), "position": self.position, "velocity": [0.0, 0.0], "stamp": self.now}
        return self.controller.update(self.now, JointState(**joints | state), goal, interlocks)

    def drive(self):
        self.tick(goal=GOAL)
        for _ in range(5):
            assert self.tick().state is State.ACTIVE
        assert self.policy.given[-1].any()

    def asked_next(self, **tick):
        """What the policy is told at the next tick at which it is asked."""
        before = len(self.policy.given)
        for _ in range(20):
            self.tick(**tick)
            tick.pop("goal", None)
            if len(self.policy.given) > before:
                return self.policy.given[-1]
        raise AssertionError("it was never asked again")


@pytest.fixture
def robot(recurrent):
    robot = Robot(recurrent)
    robot.drive()
    robot.policy.trouble = None
    return robot


def test_the_memory_begins_with_zeros_and_goes_on_from_tick_to_tick(recurrent):
    robot = Robot(recurrent)
    robot.drive()
    memory = np.zeros(SIZE, np.float32)
    for given in robot.policy.given:
        assert np.array_equal(given, memory)
        _, memory = recurrent(robot.position, [0.0, 0.0], GOAL.value, memory)


def hold(robot):
    robot.tick(position=[math.nan, 0.0], after=0.2)


def late(robot):
    robot.tick(after=0.08)


def interlock(robot):
    robot.tick(interlocks=["not enabled"])


def stop(robot):
    robot.controller.emergency_stop()
    robot.tick()
    robot.controller.reset()


def reset_without_a_tick(robot):
    robot.controller.emergency_stop()
    robot.controller.reset()


def forgotten_goal(robot):
    robot.controller.forget_goal()


def fault(robot):
    robot.policy.trouble = lambda command, memory: (command * math.nan, memory)
    for _ in range(3):
        state = robot.tick().state
    assert state is State.FAULT
    robot.policy.trouble = None
    robot.controller.reset()


def one_failure(robot):
    robot.policy.trouble = lambda command, memory: (command[:1], memory)
    assert robot.tick().state is State.ACTIVE
    robot.policy.trouble = None


def arrival(robot):
    here = robot.position
    tip = [0.3 * math.cos(0.5) + 0.25 * math.cos(1.5), 0.3 * math.sin(0.5) + 0.25 * math.sin(1.5)]
    assert robot.tick(goal=Goal(tip, "base")).state is State.REACHED
    assert robot.position is here


@pytest.mark.parametrize(
    "interrupt", [hold, late, interlock, stop, reset_without_a_tick, forgotten_goal, fault, one_failure, arrival]
)
def test_after_whatever_is_not_driving_the_memory_begins_anew(robot, interrupt):
    interrupt(robot)
    assert not robot.asked_next(goal=GOAL).any()


def test_a_new_goal_begins_a_new_memory_and_the_same_goal_again_does_not(robot):
    assert robot.asked_next(goal=GOAL).any()
    nearly = Goal([x + 0.001 for x in GOAL.value], "base")
    assert robot.asked_next(goal=nearly).any()
    assert robot.asked_next(goal=Goal([9.0, 9.0], "base")).any()  # refused: the old one stays
    assert not robot.asked_next(goal=OTHER_GOAL).any()
    assert robot.asked_next().any()


@pytest.mark.parametrize(
    ("trouble", "reason"),
    [
        (lambda command, memory: (command, memory * math.nan), "the policy gave a memory that is not finite"),
        (lambda command, memory: (command, np.full(SIZE, math.inf)), "the policy gave a memory that is not finite"),
        (lambda command, memory: (command, memory[:-1]), "the policy gave a memory of the shape [39]"),
        (lambda command, memory: (command, None), "the policy gave a memory of the shape []"),
        (lambda command, memory: command, "the policy gave the shape []"),
    ],
)
def test_a_memory_that_is_none_is_a_failure_with_zero_velocity_and_thrice_a_fault(robot, trouble, reason):
    robot.policy.trouble = trouble
    for _ in range(3):
        command = robot.tick()
        assert command.value.tolist() == [0.0, 0.0]
        assert reason in " ".join(command.reasons)
    assert command.state is State.FAULT


def test_a_memory_that_is_spoilt_from_outside_never_moves_the_arm(robot):
    robot.controller._memory = np.full(SIZE, math.nan, np.float32)
    command = robot.tick()
    assert command.value.tolist() == [0.0, 0.0]
    assert "the policy gave a command that is not finite" in command.reasons
    assert not robot.asked_next().any()


@pytest.mark.parametrize("times", [2, 4, 10])
def test_asked_more_often_than_in_training_it_remembers_at_the_pace_of_its_training(recurrent, times):
    slow, fast = Robot(recurrent), Robot(recurrent)
    slow.tick(goal=GOAL)
    fast.tick(goal=GOAL)
    for _ in range(10):
        slow.tick()
    for _ in range(10 * times):
        fast.tick(after=PERIOD / times)
    paces = [len({memory.tobytes() for memory in robot.policy.given}) for robot in (slow, fast)]
    assert paces[0] == 11
    assert abs(paces[1] - paces[0]) <= 1
