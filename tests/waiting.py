"""Waiting for what happens elsewhere: polled, so that a busy machine makes a test slow and not wrong."""

import time
from collections.abc import Callable
from typing import Any

from tests.forge import Forked


def wait_for(condition: Callable[[], Any], timeout: float = 60.0, what: str | Callable[[], str] = "") -> Any:
    """Return what the condition returns as soon as it is true; ``what`` may be asked once it is too late."""
    began = time.monotonic()
    while not (result := condition()):
        waited = time.monotonic() - began
        assert waited < timeout, f"waited {timeout} s in vain: {(what() if callable(what) else what) or condition}"
        time.sleep(min(0.002 + waited / 20, 0.02))  # who waits for long leaves the processor to the others
    return result


def wait_while_runs(process: Forked, condition: Callable[[], Any], timeout: float = 240.0, what: str = "") -> Any:
    """Wait for what a process brings about; fail at once if it ends before."""

    def reached() -> Any:
        ended = process.poll() is not None
        found = condition()
        assert found or not ended, process.communicate()[0]
        return found

    return wait_for(reached, timeout, what or f"what process {process.pid} was to bring about")
