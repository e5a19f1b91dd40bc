"""Standard output that never makes a node wait: a terminal may be stopped, a pipe unread, a disk full.

rclpy writes log lines with the interpreter's lock held, so that a line which cannot be written stops every thread. Here
they go to a pipe that is never full: a thread empties it into a queue with bounds, and another one writes that to where
it belongs. What does not fit is counted, and said there when it can be.
"""

import contextlib
import fcntl
import io
import os
import queue
import select
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

_ROOM = 500  # lines that may wait for a slow reader
_LONGEST = 512  # bytes of a line; what a longer one has beyond them counts as another
_PIPE = 2**20  # bytes of the pipe, for bursts
_PATIENCE = 0.5  # s for what still waits when a node ends

_outlets: "list[Outlet]" = []


def open_closed() -> None:
    """Put /dev/null where standard input, output or error is closed: a socket of DDS would take its number."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)


def dropped_lines() -> int:
    """How many lines have been lost since the program started."""
    return sum(outlet.dropped for outlet in _outlets)


@contextlib.contextmanager
def outlets() -> Iterator[None]:
    """Put outlets before standard output and error, for the rest of the program; at the end they get half a second."""
    if os.isatty(2):
        os.environ.setdefault("RCUTILS_COLORIZED_OUTPUT", "1")  # rcutils would look at the pipe
    os.environ.setdefault("RCUTILS_LOGGING_BUFFERED_STREAM", "1")  # a line at a time, also to a pipe
    # One for both keeps the order of their lines, where both are shown in one place.
    made = [Outlet([1, 2])] if os.path.sameopenfile(1, 2) else [Outlet([1]), Outlet([2])]
    _outlets.extend(made)
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _text(1), _text(2)
    for stream in before:
        with contextlib.suppress(OSError, AttributeError):  # None, where it was closed
            stream.flush()
    try:
        yield
    finally:
        end = time.monotonic() + _PATIENCE
        for outlet in made:
            outlet.close()
        for outlet in made:
            outlet.wait(end - time.monotonic())


class Outlet:
    """Stands before a descriptor: what is written to it never waits, and is passed on as fast as it is taken.

    Args:
        numbers: Descriptors that lead to the same place.
    """

    def __init__(self, numbers: Sequence[int]) -> None:
        self._numbers = numbers
        self._real = os.dup(numbers[0])
        self._source, pipe = os.pipe()
        with contextlib.suppress(OSError):  # more than this user may have
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE)
        os.set_blocking(pipe, False)
        for number in numbers:
            os.dup2(pipe, number)
        os.close(pipe)
        self._unread, self._unwritten = 0, 0
        self._lines: queue.Queue[tuple[int, bytes]] = queue.Queue(_ROOM)  # each behind so many lost ones
        self._writer = threading.Thread(target=self._pass_on, name="outlet", daemon=True)
        self._writer.start()
        threading.Thread(target=self._take, name="outlet, in", daemon=True).start()

    @property
    def dropped(self) -> int:
        """Lines that have been lost."""
        return self._unread + self._unwritten

    def close(self) -> None:
        """Take nothing any more."""
        null = os.open(os.devnull, os.O_WRONLY)
        for number in self._numbers:
            os.dup2(null, number)  # closes the pipe, so that its reader ends
        os.close(null)

    def wait(self, timeout: float) -> None:
        """Wait until all is written, at most for so long, s."""
        self._writer.join(max(0.0, timeout))

    def _take(self) -> None:
        lost = 0
        with open(self._source, "rb") as source:
            for line in iter(lambda: source.readline(_LONGEST), b""):
                # After a lost one all are, until none waits any more: one gap, and it can be said where it is.
                if self._lines.full() or (lost and not self._lines.empty()):
                    lost += 1
                    self._unread += 1
                else:
                    self._lines.put((lost, line))
                    lost = 0
        self._lines.put((lost, b""))  # the end

    def _pass_on(self) -> None:
        untold = 0
        while True:
            lost, line = self._lines.get()
            untold += lost
            written = self._write(_gap(untold) + line)
            if not line:
                return
            untold = 0 if written else untold + 1
            self._unwritten += not written

    def _write(self, data: bytes) -> bool:
        """Return whether all could be written: a full disk, or a reader that has gone, is no reason to end."""
        while data:
            try:
                data = data[os.write(self._real, data) :]
            except BlockingIOError:  # another program has made it so
                select.select([], [self._real], [])
            except OSError:
                return False
        return True


def _gap(lines: int) -> bytes:
    return f"[WARN] {lines} lines of this output are missing here: they were not taken in time\n".encode() * (lines > 0)


def _text(number: int) -> io.TextIOWrapper:
    # Nothing between: a write that finds no room returns at once, and there is nothing to wait for at the end.
    descriptor: Any = io.FileIO(number, "w", closefd=False)
    return io.TextIOWrapper(descriptor, "utf-8", "backslashreplace", line_buffering=True)
