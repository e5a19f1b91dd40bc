"""Forking a process that is to work for this one, and what it does first."""

import contextlib
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Iterator

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_PR_SET_PDEATHSIG = 1


@contextlib.contextmanager
def signals_wait() -> Iterator[None]:
    """Context to fork in: signals that arrive in it are handled at its end.

    Python drops what a handler raises in that moment, Ctrl-C, too, and the new process would raise it as well.
    """
    if threading.current_thread() is not threading.main_thread():  # no handler is called in another
        yield
        return
    arrived: list[int] = []
    before = {number: signal.signal(number, lambda number, _: arrived.append(number)) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for arrival in arrived:
            signal.raise_signal(arrival)


def follow(parent: int) -> None:
    """Leave it to the parent what signals mean that reach all processes of a terminal or a container; end with it.

    Args:
        parent: Process id, taken before the fork.
    """
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    if sys.platform == "linux":  # pipes do not tell that the parent was killed: each child holds both ends of others'
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            sys.exit(1)
