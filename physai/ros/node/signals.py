"""Signals end a node in order: they are noted, however many come, and it looks."""

import signal
from types import FrameType

_SIGNALS = (
    signal.SIGINT,
    signal.SIGTERM,
    signal.SIGHUP,
    signal.SIGQUIT,
    signal.SIGUSR1,
    signal.SIGUSR2,
    signal.SIGALRM,
    signal.SIGTSTP,  # Ctrl-Z: a node that is stopped leaves the arm moving
)


def end_quietly() -> None:
    """While a program is still importing, Ctrl-C ends it as SIGTERM does: without a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def catch() -> dict[int, FrameType | None]:
    """Note signals from now on, instead of dying of them.

    Returns:
        Gets a key for each signal that comes, the first one first.
    """
    caught: dict[int, FrameType | None] = {}
    for number in _SIGNALS:
        # No Python code: the next signal would come in the middle of it, and so on, until the stack is full.
        signal.signal(number, caught.setdefault)
    # A program in the background that writes to its terminal would be stopped there.
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    return caught


def ignore() -> None:
    """At the end: Python takes handlers away before the process is gone, and a late signal would be its exit code."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
