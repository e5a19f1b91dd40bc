"""Robots whose physics several processes compute at the same time."""

import contextlib
import math
import mmap
import multiprocessing
import os
import pickle
import select
import signal
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from typing import Any, ClassVar

import numpy as np

from physai.errors import UserError
from physai.forked import follow
from physai.physics.interface import DynamicsParameters, Physics
from physai.robots import RobotSpec

_STEP = "step"
_AWAKE = 0.002  # s; a process that is asked more rarely than this may as well sleep


class ParallelPhysics:
    """Shares of the robots in processes of their own, the first share in this one.

    Each robot moves bit for bit as it does in one process; the interface is :class:`physai.physics.Physics`.

    Args:
        spec: The robot.
        num_robots: N.
        control_dt: Control period, s.
        substeps: Physics steps per control period.
        physics: Makes the physics of a share, from these four.
        processes: How many there are, with this one.

    Raises:
        UserError: If there are more processes than robots; or, at any later call, if one of them has died.
    """

    simulated: ClassVar[bool] = True

    def __init__(
        self,
        spec: RobotSpec,
        num_robots: int,
        control_dt: float,
        substeps: int,
        physics: Callable[[RobotSpec, int, float, int], Physics],
        processes: int,
    ) -> None:
        if not 1 <= processes <= num_robots:
            raise UserError(f"processes: between 1 and the number of robots, {num_robots}, not {processes}")
        self.num_robots = num_robots
        first, *others = np.array_split(np.arange(num_robots), processes)
        self._borders = [int(share[0]) for share in others]
        shape = 3, num_robots, len(spec.joints)
        # Command, position and velocity of all robots, which all processes see: a step sends no more than a sign.
        self._moment = np.frombuffer(mmap.mmap(-1, 8 * math.prod(shape))).reshape(shape)
        self._workers: list[_Worker] = []
        Finalize(self, _end, (self._workers,))  # of physics that nobody closes; not that of its copy in a fork
        with contextlib.ExitStack() as undo:
            undo.callback(_end, self._workers)
            for share in others:
                moment = self._moment[:, share[0] : share[-1] + 1]
                self._workers.append(_Worker(physics, (spec, len(share), control_dt, substeps), moment))
            self._own = physics(spec, len(first), control_dt, substeps)
            undo.callback(self._own.close)
            self._own_moment = self._moment[:, : len(first)]
            for worker in self._workers:
                worker.answer()
            undo.pop_all()
        self._own_moment[1:] = self._own.joint_state()

    def _call(self, name: str, arguments: Sequence[tuple[Any, ...] | None], wait: bool = True) -> list[Any]:
        """Call a method of every share that has arguments; return what they return, or do not wait for it."""
        if len(self._workers) < len(self._borders):
            raise UserError("the physics is closed")
        first, *others = arguments
        asked = [worker for worker, given in zip(self._workers, others, strict=True) if given is not None]
        try:
            for worker, given in zip(self._workers, others, strict=True):
                if given is not None:
                    worker.ask(name, given, wait)
            own = [] if first is None else [_do(self._own, self._own_moment, name, first)]
            return own + [worker.answer() for worker in asked if wait]
        except BaseException:  # an answer that nobody has fetched would be taken for that to the next call
            self.close()
            raise

    def reset(
        self,
        rows: np.ndarray,
        joint_position: np.ndarray,
        joint_velocity: np.ndarray,
        parameters: DynamicsParameters | None = None,
    ) -> None:
        """See :meth:`physai.physics.Physics.reset`."""
        share = np.searchsorted(self._borders, rows, side="right")
        arguments: list[tuple[Any, ...] | None] = []
        for number, start in enumerate([0, *self._borders]):
            its = share == number
            new = None if parameters is None else {key: value[its] for key, value in parameters.items()}
            given = rows[its] - start, joint_position[its], joint_velocity[its], new
            arguments.append(given if its.any() else None)
        self._call("reset", arguments, wait=False)
        self._moment[1:, rows] = joint_position, joint_velocity

    def step(self, velocity_command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See :meth:`physai.physics.Physics.step`."""
        command, *_ = self._moment
        if velocity_command.shape != command.shape:
            raise ValueError(f"commands of shape {command.shape} are needed, got {velocity_command.shape}")
        command[:] = velocity_command
        self._call(_STEP, [()] * (len(self._borders) + 1))
        return self.joint_state()

    def step_one(self, velocity_command: list[float]) -> tuple[list[float], list[float]]:
        """See :meth:`physai.physics.Physics.step_one`."""
        position, velocity = self.step(np.array([velocity_command]))
        return position[0].tolist(), velocity[0].tolist()

    def joint_state(self) -> tuple[np.ndarray, np.ndarray]:
        """See :meth:`physai.physics.Physics.joint_state`."""
        _, position, velocity = self._moment.copy()
        return position, velocity

    def parameters(self) -> DynamicsParameters:
        """See :meth:`physai.physics.Physics.parameters`."""
        return self._rows_of("parameters")

    def state(self) -> dict[str, np.ndarray]:
        """See :meth:`physai.physics.Physics.state`."""
        return self._rows_of("state")

    def _rows_of(self, name: str) -> dict[str, np.ndarray]:
        shares = self._call(name, [()] * (len(self._borders) + 1))
        return {key: np.concatenate([share[key] for share in shares]) for key in shares[0]}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """See :meth:`physai.physics.Physics.set_state`."""
        values = zip(*(np.split(value, self._borders) for value in state.values()), strict=True)
        self._call("set_state", [(dict(zip(state, share, strict=True)),) for share in values])
        self._moment[1:] = state["joint_position"], state["joint_velocity"]

    def close(self) -> None:
        """See :meth:`physai.physics.Physics.close`."""
        _end(self._workers)
        self._own.close()


def _end(workers: list["_Worker"]) -> None:
    while workers:
        workers.pop().end()


def _do(physics: Physics, moment: np.ndarray, name: str, arguments: tuple[Any, ...]) -> Any:
    """Call a method; a step takes its command from the moment [3, share, n], and leaves the state there."""
    if name != _STEP:
        return getattr(physics, name)(*arguments)
    moment[1:] = physics.step(moment[0])
    return None


class _Worker:
    """The physics of a share in a process of its own; its first answer says that it is there."""

    def __init__(self, physics: Callable[..., Physics], arguments: tuple[Any, ...], moment: np.ndarray) -> None:
        context = multiprocessing.get_context("fork")  # at once; a fresh process would import for seconds
        self._connection, theirs = context.Pipe()
        serve = os.getpid(), self._connection, theirs, physics, arguments, moment
        self._process = context.Process(target=_serve, args=serve, daemon=True)
        self._process.start()
        theirs.close()
        self._receive = _receiver(self._connection)

    def ask(self, name: str, arguments: tuple[Any, ...], wait: bool) -> None:
        try:
            self._connection.send_bytes(b"" if name == _STEP else pickle.dumps((name, arguments, wait)))
        except OSError:
            raise self._gone() from None

    def answer(self) -> Any:
        try:
            answer = self._receive()
        except (EOFError, OSError):
            raise self._gone() from None
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _gone(self) -> UserError:
        self._process.join(timeout=1)
        return UserError(f"a process that computes physics has ended (exit code {self._process.exitcode})")

    def end(self) -> None:
        self._connection.close()
        self._process.kill()  # it holds nothing that outlives it
        self._process.join()
        self._process.close()


def _serve(
    parent: int,
    parents: Connection,
    connection: Connection,
    physics: Callable[..., Physics],
    arguments: tuple[Any, ...],
    moment: np.ndarray,
) -> None:
    parents.close()  # which would otherwise keep this end from ever seeing an end
    follow(parent)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # by which Python ends what was not closed
    try:
        share = physics(*arguments)
    except Exception as error:
        connection.send(error)
        return
    moment[1:] = share.joint_state()
    connection.send_bytes(b"")
    receive, failure = _receiver(connection), None
    while True:
        try:
            name, given, wait = receive() or (_STEP, (), True)
        except EOFError:  # nobody has this physics any more
            return
        try:
            answer = _do(share, moment, name, given)
        except Exception as error:
            failure = failure or error
        if wait and failure is None and answer is None:
            connection.send_bytes(b"")
        elif wait:
            connection.send(failure or answer)
            failure = None


def _receiver(connection: Connection) -> Callable[[], Any]:
    """Make what receives from a connection, None if it is empty.

    Waking up would take longer than a step takes, so it looks for a while before it sleeps.
    """
    poll = select.poll()
    poll.register(connection, select.POLLIN)

    def receive() -> Any:
        asleep = time.perf_counter() + _AWAKE
        while not poll.poll(0) and time.perf_counter() < asleep:
            pass
        message = connection.recv_bytes()
        return pickle.loads(message) if message else None

    return receive
