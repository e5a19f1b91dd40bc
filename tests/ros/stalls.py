"""Whether the machine itself stood still: a virtual one does, for half a second at times, and robots cannot."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LONGEST = 0.04  # s; nodes have 50 ms for what is hardest
_WATCH = f"""
import os, sys, time
os.sched_setaffinity(0, {{int(sys.argv[1])}})
parent, last = os.getppid(), time.monotonic()
while os.getppid() == parent:
    time.sleep(0.01)
    now = time.monotonic()
    if now - last > {LONGEST}:
        print(now, now - last, flush=True)
    last = now
"""


class Stalls:
    """Notes the time of each stall, by a process on each core that should wake up every 10 ms; only on Linux."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="physai-stalls-")
        self.watchers: list[subprocess.Popen[bytes]] = []
        for core in sorted(os.sched_getaffinity(0)) if sys.platform == "linux" else ():
            with open(self._noted(core), "w") as noted:
                self.watchers.append(subprocess.Popen([sys.executable, "-S", "-c", _WATCH, str(core)], stdout=noted))

    def _noted(self, core: int) -> Path:
        return Path(self._folder.name) / str(core)

    def longest(self, since: float) -> float:
        """Return how long the longest stall was, s, of those that ended after a time; 0.0 if there was none."""
        time.sleep(0.05)  # what has just ended is noted then
        lines = [line.split() for noted in Path(self._folder.name).iterdir() for line in noted.read_text().splitlines()]
        return max((float(length) for end, length in lines if float(end) > since), default=0.0)

    def close(self) -> None:
        for watcher in self.watchers:
            watcher.kill()
            watcher.wait()
        self._folder.cleanup()
