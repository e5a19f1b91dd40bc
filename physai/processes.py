"""Processes that work for this one: how they start, and that they end with it, however it ends."""

import contextlib
import ctypes
import functools
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""What ends a program, and reaches all processes of a terminal or a container."""

_PR_SET_PDEATHSIG = 1  # Linux: prctl(2)


def die_with(parent: int, number: int = signal.SIGKILL) -> None:
    """Ask Linux to send this process a signal as soon as its parent is gone; elsewhere nothing does.

    It must be called in the new process. A pipe would not tell it: each child holds both ends of the others' pipes.

    Args:
        parent: Process id, taken before the new process was made.
        number: The signal.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:  # it has died meanwhile, and no signal comes any more
            os._exit(1)


def follow(parent: int) -> None:
    """End with the parent, and leave it to the parent what :data:`SIGNALS` mean.

    Args:
        parent: Process id, taken before the fork.
    """
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    die_with(parent)


@functools.cache  # a process may run several jobs
def end_with(starter: int) -> None:
    """Stop this process, as SIGTERM does, once the one that it works for is gone, which need not be its parent.

    Args:
        starter: Process id.
    """

    def watch() -> None:
        with contextlib.suppress(ProcessLookupError):  # it is gone already
            select.select([os.pidfd_open(starter)], [], [])  # also ends where nobody has asked how the starter ended
        os.kill(os.getpid(), signal.SIGTERM)  # a run saves itself
        time.sleep(20)
        os._exit(128 + signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def handling(numbers: Iterable[int], handler: Callable[[int, Any], object] | None = None) -> Iterator[None]:
    """Context after which signals have the handlers again that they had before.

    Args:
        numbers: The signals.
        handler: What handles them meanwhile; None leaves that as it is.
    """
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        if handler is not None:
            for number in before:
                signal.signal(number, handler)
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextlib.contextmanager
def signals_wait() -> Iterator[None]:
    """Context to fork in: signals that arrive in it are handled at its end.

    Python drops what a handler raises in that moment, Ctrl-C, too, and the new process would raise it as well.
    """
    if threading.current_thread() is not threading.main_thread():  # no handler is called in another
        yield
        return
    arrived: list[int] = []
    try:
        with handling(SIGNALS, lambda number, _: arrived.append(number)):
            yield
    finally:
        for arrival in arrived:
            signal.raise_signal(arrival)


def kill_with_this(processes: Iterable[int]) -> "subprocess.Popen[bytes]":
    """Have processes killed when this one is gone that cannot be told to :func:`follow` it: others started them.

    Args:
        processes: Their ids.

    Returns:
        What waits for the end of this process; kill it when they have ended.
    """
    # read ends with this process, which holds the only other end of the pipe
    command = ["sh", "-c", f"read _; kill -9 {' '.join(map(str, processes))} 2> /dev/null"]
    return subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
