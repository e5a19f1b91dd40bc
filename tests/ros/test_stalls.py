"""What tests in real time excuse themselves with."""

import os
import signal
import sys
import time

import pytest

from tests.ros.stalls import Stalls


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.skipif(sys.platform != "linux", reason="cores are watched on Linux")
def test_a_core_that_stands_still_is_noticed_and_is_over_afterwards():
    stalls = Stalls()
    try:
        time.sleep(0.3)  # until they watch
        began = time.monotonic()
        os.kill(stalls.watchers[0].pid, signal.SIGSTOP)
        time.sleep(0.5)
        os.kill(stalls.watchers[0].pid, signal.SIGCONT)
        time.sleep(0.05)
        assert 0.4 < stalls.longest(since=began) < 5.0
        assert stalls.longest(since=time.monotonic()) == 0.0
    finally:
        stalls.close()
    assert all(watcher.returncode is not None for watcher in stalls.watchers)
