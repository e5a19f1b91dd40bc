"""How a run is asked to stop, and says that it did."""

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import NoReturn

from physai.processes import handling


def end_stopped(number: int, run_dir: Path) -> NoReturn:
    """End as a signal has asked for, once everything is saved."""
    name = signal.Signals(number).name
    print(f"\nStopped by {name}; everything is saved. Go on with:\n  python -m physai.train resume={run_dir}")
    sys.exit(128 + number)


@contextlib.contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM instead of dying by them; a second one is obeyed at once."""
    received: list[int] = []

    def remember(number: int, frame: FrameType | None) -> None:
        if received:
            os._exit(128 + number)
        received.append(number)

    with handling((signal.SIGINT, signal.SIGTERM), remember):
        yield received
