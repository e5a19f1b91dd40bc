"""What the tests of deployment share: the real policy, and one that misbehaves on demand."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physai.deploy import Policy, load_policy

pytest.register_assert_rewrite("tests.deploy.world")


@pytest.fixture(scope="session")
def policy(exported_run) -> Policy:
    """The real policy of a two-link arm: loaded once, not to be changed."""
    return load_policy(exported_run / "policy.pt")


def _raise(command: np.ndarray) -> None:
    raise RuntimeError("the network is gone")


FAILURES: dict[str, Callable[[np.ndarray], Any]] = {
    "NaN": lambda command: command * math.nan,
    "one NaN": lambda command: np.array([0.1, math.nan]),
    "infinite": lambda command: np.array([math.inf, 0.0]),
    "wrong shape": lambda command: command[:1],
    "a row too much": lambda command: command[None],
    "nothing": lambda command: None,
    "text": lambda command: "stop",
    "exception": _raise,
    "slow": lambda command: command,
}
DISTANCES = {"distance NaN": math.nan, "distance infinite": math.inf, "distance negative": -0.01}
ALL_FAILURES = (*FAILURES, *DISTANCES)


class Troubled:
    """A policy that answers as the one inside, unless ``trouble`` is one of ALL_FAILURES or a function of its command.

    With the trouble "emergency stop" it calls ``stop``, too. Its stopwatch stands still but for slow answers.
    """

    def __init__(self, policy: Any) -> None:
        self.policy, self.metadata, self.sha256 = policy, policy.metadata, policy.sha256
        self.trouble: str | Callable[[np.ndarray], Any] | None = None
        self.stop: Callable[[], None] | None = None
        self.seconds = 0.0
        self.forget()

    def forget(self) -> None:
        self.measured: float | None = None
        self.called = self.failed = self.stopped = False

    def stopwatch(self) -> float:
        return self.seconds

    def distance(self, joint_position: np.ndarray, goal: np.ndarray) -> float:
        self.goal = goal
        if self.trouble in DISTANCES:
            self.failed = True
            return DISTANCES[self.trouble]
        self.measured = self.policy.distance(joint_position, goal)
        return self.measured

    def __call__(self, joint_position: np.ndarray, joint_velocity: np.ndarray, goal: np.ndarray) -> Any:
        self.called = True
        command = self.policy(joint_position, joint_velocity, goal)
        if self.trouble is None:
            return command
        if not isinstance(self.trouble, str):
            return self.trouble(command)
        if self.trouble == "emergency stop":
            self.stopped = True
            self.stop()
            return command
        self.failed = True
        self.seconds += self.trouble == "slow"
        return FAILURES[self.trouble](command)


@pytest.fixture(scope="session")
def content(exported_run) -> bytes:
    return (exported_run / "policy.pt").read_bytes()


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "policy.pt"
