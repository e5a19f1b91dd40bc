"""A policy that misbehaves on demand."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from physai.signals import Quantity


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
ERRORS = {"error NaN": [math.nan], "error infinite": [math.inf], "error negative": [-0.01], "two errors": [0.1, 0.1]}
ALL_FAILURES = (*FAILURES, *ERRORS)


class Troubled:
    """A policy that answers as the one inside, unless ``trouble`` is one of ALL_FAILURES or a function of its command.

    With the trouble "emergency stop" it calls ``stop``, too. Its stopwatch stands still but for slow answers. A
    function is one of the velocity that is commanded, also where commands are positions.
    """

    def __init__(self, policy: Any) -> None:
        self.policy, self.metadata, self.sha256 = policy, policy.metadata, policy.sha256
        self.trouble: str | Callable[[np.ndarray], Any] | None = None
        self.stop: Callable[[], None] | None = None
        self.seconds = 0.0
        self.forget()

    def forget(self) -> None:
        self.error_told: float | None = None
        self.called = self.failed = self.stopped = False

    def stopwatch(self) -> float:
        return self.seconds

    def error(self, joint_position: np.ndarray, goal: np.ndarray) -> np.ndarray:
        self.goal = goal
        if self.trouble in ERRORS:
            self.failed = True
            return np.array(ERRORS[self.trouble])
        error = self.policy.error(joint_position, goal)
        self.error_told = float(error[0])
        return error

    def __call__(self, *inputs: np.ndarray) -> Any:
        self.called = True
        self.inputs = inputs
        command = self.policy(*inputs)
        if self.trouble is None:
            return command
        if not isinstance(self.trouble, str):
            if self.metadata.command.quantity is Quantity.JOINT_VELOCITY:
                return self.trouble(command)
            last, period = np.asarray(inputs[3], np.float64), 1.0 / self.metadata.control_rate
            return last + self.trouble((command - last) / period) * period
        if self.trouble == "emergency stop":
            self.stopped = True
            self.stop()
            return command
        self.failed = True
        self.seconds += self.trouble == "slow"
        return FAILURES[self.trouble](command)
