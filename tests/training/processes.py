"""Finding the processes of a run, in /proc."""

import time
from pathlib import Path


def command_of(process: int) -> str:
    """The command line; empty for a process that is gone."""
    try:
        return Path(f"/proc/{process}/cmdline").read_text().replace("\0", " ")
    except OSError:
        return ""


def descendants(process: int) -> set[int]:
    """What a process has started, and what that has; without Python's own tracker of shared memory."""
    try:
        listed = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return set()
    children = {int(child) for child in listed if "resource_tracker" not in command_of(int(child))}
    return children.union(*map(descendants, children))


def all_gone(processes: set[int], seconds: float = 30) -> bool:
    """Whether all processes end in time; one that nobody has asked for its exit code has ended, too."""
    deadline = time.monotonic() + seconds
    while any(map(command_of, processes)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not any(map(command_of, processes))
