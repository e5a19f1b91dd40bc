"""Processes end with the one that they work for, even if it is killed."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest

from physai.processes import signals_wait

PARENTS = {
    "die_with": """
import os, subprocess
from functools import partial
from physai.processes import die_with
child = subprocess.Popen(["sleep", "60"], preexec_fn=partial(die_with, os.getpid()))
""",
    "follow": """
import os, time
from types import SimpleNamespace
from physai.processes import follow
parent, pid = os.getpid(), os.fork()
if not pid:
    follow(parent)
    time.sleep(60)
child = SimpleNamespace(pid=pid)
""",
    "kill_with_this": """
import subprocess
from physai.processes import kill_with_this
child = subprocess.Popen(["sleep", "60"])
watcher = kill_with_this([child.pid])
""",
}


def alive(pid: int) -> bool:
    """Whether it runs: one that has ended, and that nobody has asked for its exit code, does not."""
    with contextlib.suppress(OSError):
        return open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()[0] != "Z"
    return False


@pytest.mark.skipif(sys.platform != "linux", reason="a signal at the death of the parent is Linux's")
@pytest.mark.parametrize("way", PARENTS)
def test_a_process_dies_with_a_parent_that_is_killed(way):
    code = f"{PARENTS[way]}\nimport time\nprint(child.pid, flush=True)\ntime.sleep(60)"
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert alive(child)
    time.sleep(0.1)  # follow is called after the fork
    parent.kill()
    parent.wait()
    parent.stdout.close()
    end = time.monotonic() + 10
    while alive(child):
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_signal_that_comes_while_a_process_is_made_is_handled_afterwards():
    done = False
    with pytest.raises(KeyboardInterrupt), signals_wait():  # noqa: PT012
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.05)
        done = True
    assert done
