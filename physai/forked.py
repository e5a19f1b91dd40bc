"""What a process does first that was forked to work for another."""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def follow(parent: int) -> None:
    """Leave it to the parent what signals mean that reach all processes of a terminal or a container; end with it.

    Args:
        parent: Process id, taken before the fork.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)
    if sys.platform == "linux":  # pipes do not tell that the parent was killed: each child holds both ends of others'
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            sys.exit(1)
