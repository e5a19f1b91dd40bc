"""Many nodes of one program: what they import, which takes longest and most memory, is there once for all of them."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from physai.processes import die_with, signals_wait

_PATIENCE = 5.0  # s


class ForkedProcess:
    """Nodes of physai in a process that is forked from this one, which must not have started ROS yet.

    It ends with this process. Ctrl-C is for this one alone, which ends its nodes in their order.

    Args:
        name: Whose it is, such as ``inference nodes``.
        log: Where its output goes; what it has to remember is kept beside.
        work: What it does; returns its exit code.
        arguments: Of its command line.
    """

    def __init__(self, name: str, log: Path, work: Callable[[], int], arguments: Sequence[str] = ()) -> None:
        self.name = name
        self.log = log
        self._code: int | None = None
        this = os.getpid()
        with signals_wait():
            self.pid = os.fork()
            if self.pid == 0:
                _become(work, [name, *arguments], log, this)

    @property
    def ended(self) -> bool:
        """Whether it has ended."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code is not None

    def last_words(self) -> str:
        """The last line of its output."""
        lines = [line for line in self.log.read_text(errors="replace").splitlines() if line.strip()]
        return lines[-1] if lines else "no output"


def ros_arguments(namespace: str, **parameters: object) -> list[str]:
    """What ROS is told of a node."""
    arguments = ["--ros-args", "-r", f"__ns:={namespace}"]
    for name, value in parameters.items():
        arguments += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
    return arguments


def end(processes: Iterable[ForkedProcess]) -> None:
    """Have processes end, side by side, and wait for them."""
    processes = list(processes)
    for number, patience in ((signal.SIGTERM, _PATIENCE), (signal.SIGKILL, _PATIENCE)):
        for process in processes:
            if not process.ended:
                os.kill(process.pid, number)
        until = time.monotonic() + patience
        while not all(process.ended for process in processes) and time.monotonic() < until:
            time.sleep(0.01)


def _become(work: Callable[[], int], arguments: Sequence[str], log: Path, parent: int) -> None:
    """Be the nodes; nothing of the program that was forked goes on."""
    code = 1
    try:
        die_with(parent, signal.SIGTERM)
        os.setsid()
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for number, target in ((os.open(os.devnull, os.O_RDONLY), 0), (output, 1), (output, 2)):
            os.dup2(number, target)
        os.environ["XDG_STATE_HOME"] = str(log.parent.absolute())  # no other robot's emergency stop
        sys.argv = list(arguments)
        code = work()
    finally:
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
