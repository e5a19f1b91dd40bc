"""A policy that is asked with care: it is a foreign program, and what it answers is looked at before anything moves."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from physai.deploy.policy import Driver
from physai.errors import UserError


class AnswerError(Exception):
    """An answer that is none: ``kind`` for counting, and what the policy did."""

    def __init__(self, kind: str, what: str) -> None:
        super().__init__(what)
        self.kind = kind


class CheckedPolicy:
    """Asks a policy, and lets no answer through that is of another shape, not finite, or too late.

    Args:
        policy: From :func:`physai.deploy.load_policy`.
        stopwatch: Measures how long it takes, s.
        known: Names of what the controller can tell it.

    Attributes:
        nothing: What it remembers when an episode begins: zeros, [H].

    Raises:
        UserError: If the policy takes an input that a controller cannot tell it.
    """

    def __init__(self, policy: Driver, stopwatch: Callable[[], float], known: Sequence[str]) -> None:
        metadata = policy.metadata
        self._policy, self._stopwatch = policy, stopwatch
        self._inputs = [signal.name for signal in metadata.inputs]
        for name in self._inputs:
            if name not in known:
                raise UserError(f"the policy takes '{name}': this controller can tell {', '.join(known)}")
        self._command = metadata.command.shape
        self._errors = (len(metadata.tolerances),)
        self.nothing = np.zeros(metadata.memory_size, np.float32)
        self._started = 0.0

    def start(self) -> None:
        """Measure from now on how long the policy takes."""
        self._started = self._stopwatch()

    def error(self, position: np.ndarray, goal: np.ndarray) -> list[float]:
        """Return how far joint positions [n], rad, are from a goal [g]: E numbers in the units of the tolerances.

        Raises:
            AnswerError: If the policy cannot say.
        """
        self.start()
        array = self._call(lambda: np.asarray(self._policy.error(position, goal), dtype=np.float64))
        error: list[float] = array.tolist()  # so few numbers are quicker without arrays
        if array.shape != self._errors or not all(0 <= each < math.inf for each in error):
            raise AnswerError("error", f"gave the error {str(error)[:80]}")
        return error

    def answer(self, known: Mapping[str, Any], timeout: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the command, [n], and the memory, [H], for what is known, by name.

        Raises:
            AnswerError: If they cannot be used, or if ``timeout`` s have passed since ``start``, which ``error`` calls.
        """
        command, memory = self._call(lambda: self._split(self._policy(*[known[name] for name in self._inputs])))
        took = self._stopwatch() - self._started
        if command.shape != self._command:
            raise AnswerError("shape", f"gave the shape {list(command.shape)}")
        if memory.shape != self.nothing.shape:
            raise AnswerError("shape", f"gave a memory of the shape {list(memory.shape)}")
        if not np.isfinite(command).all():
            raise AnswerError("not finite", "gave a command that is not finite")
        if len(memory) and not np.isfinite(memory).all():
            raise AnswerError("not finite", "gave a memory that is not finite")
        if took > timeout:
            raise AnswerError("slow", f"took {took * 1e3:.1f} ms")
        return command, memory

    def _split(self, answer: Any) -> tuple[np.ndarray, np.ndarray]:
        if not len(self.nothing):
            return np.asarray(answer, dtype=np.float64), self.nothing
        command, memory = answer
        return np.asarray(command, dtype=np.float64), np.asarray(memory, dtype=np.float32)

    def _call(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except Exception as error:
            raise AnswerError("exception", f"raised {type(error).__name__}: {_last_line(error)}") from error


def _last_line(error: Exception) -> str:
    """What went wrong; TorchScript's errors begin with a traceback."""
    return (str(error).strip().splitlines() or ["no reason given"])[-1][:80]
