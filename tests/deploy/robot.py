"""An arm that stays where a test puts it, under a controller; and what the tests of its table of faults share."""

import math

import numpy as np
import pytest

from physai.deploy import Controller, ControllerConfig, Goal, JointState, State
from tests.deploy.troubled import Troubled

PERIOD = 0.02
NAMES = ("joint1", "joint2")
FAR_GOAL = Goal([-0.4, -0.1], "base")  # the arm needs seconds to get there
DEFAULT = object()
# Of an arm that stands where a test puts it, whatever it is told; test_following.py has one that moves.
LENIENT = {"following_error": 100.0, "velocity_error": 100.0, "resume_timeout": 1000.0}
INTERLOCKS = ("not enabled", "a person is near")
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
BAD_GOALS = {
    "not finite": Goal([math.nan, 0.4], "base"),
    "malformed": Goal([0.4, 0.0, 0.0], "base"),
    "wrong frame": Goal([0.4, 0.0], "world"),
    "unreachable": Goal([2.0, 2.0], "base"),
}


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

    def distance(self, goal):
        """To a goal, in m: by the policy's own kinematics."""
        return float(self.policy.policy.error(self.position, goal)[0])

    def tip(self):
        """A goal at the end effector."""
        candidates = [
            [r * math.cos(a), r * math.sin(a)] for r in (0.4, 0.45, 0.5) for a in np.arange(-3.14, 3.14, 0.05)
        ]
        return min(candidates, key=self.distance)

    @property
    def counters(self):
        return self.controller.snapshot()["counters"]


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


def configure(robot, **values):
    robot.controller.configure(ControllerConfig(**LENIENT | values))
