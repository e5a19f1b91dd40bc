"""An emergency stop outlives the node: a file that is there says so."""

import math
import os
import threading
import time
from pathlib import Path

from physai.files import sync_folder, write_atomically

_DISK = 0.01  # s that who tells of a stop may wait for the disk
_RETRY = 1.0  # s


class EmergencyStopFile:
    """Remembers, for one node of one ROS domain, whether it is in an emergency stop.

    The file's being there is all that it says, so that it is never half written; what is in it is for people. A thread
    of its own makes and removes it, and syncs it and its folder: no disk keeps anybody waiting who has an arm to stop.

    Args:
        node: Full name of the node.
        domain: Its ROS domain.

    Attributes:
        path: The file.
        stopped: Whether it was there at the start.
        unusable: Why no stop can be remembered, as seen at the start; empty if it can.
        failure: Why the last change is not on the disk; empty if it is.
        failures: How often the disk has refused.
    """

    def __init__(self, node: str, domain: int) -> None:
        self.stopped, self.unusable, self.failure, self.failures = False, "", "", 0
        self.path = Path(os.devnull)
        try:
            self.path = _folder() / f"domain_{domain}{node.replace('/', '.')}.estop"
            self.stopped = os.path.lexists(self.path)
            trial = self.path.with_name(f"{self.path.name}.{os.getpid()}")
            write_atomically(trial, b"whether an emergency stop could be remembered\n")
            trial.unlink()
        except (OSError, RuntimeError) as error:  # RuntimeError: who has no home
            self.unusable = _why(error, self.path)
        self._wanted, self._since = self.stopped, -math.inf
        self._synced: bool | None = self.stopped  # what the disk holds for sure; None: it may be either
        self._changed = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._work, name="estop_file", daemon=True)
        self._thread.start()

    def remember(self) -> None:
        """Have the file made; does not wait for it."""
        with self._changed:
            self._wanted, self._since = True, time.monotonic()
            self._changed.notify_all()

    @property
    def pending(self) -> bool:
        """Whether the disk may still have it in time: who hears of a stop shall be able to rely on it."""
        return self._synced != self._wanted and time.monotonic() - self._since < _DISK

    def wait(self) -> None:
        """Wait until nothing is pending."""
        with self._changed:
            self._changed.wait_for(lambda: self._synced == self._wanted, _DISK)

    def forget(self) -> None:
        """Have the file removed."""
        with self._changed:
            self._wanted = False
            self._changed.notify_all()

    def close(self, timeout: float) -> None:
        """Wait for the disk, at most for so long, s."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted != self._synced or self._ended)
                wanted = self._wanted
                if wanted == self._synced:
                    return
                self._synced = None
            try:
                self._write(wanted)
                self._synced, self.failure = wanted, ""
            except OSError as error:
                self.failure = _why(error, self.path)
                self.failures += 1
            with self._changed:
                self._changed.notify_all()
                if self.failure:
                    if self._ended:
                        return
                    self._changed.wait_for(lambda: self._ended, _RETRY)  # and try for a last time

    def _write(self, stopped: bool) -> None:
        if stopped:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "wb", 0) as file:
                file.write(f"emergency stop at {time.strftime('%Y-%m-%d %H:%M:%S')}, until ~/reset\n".encode())
                os.fsync(file.fileno())
        else:
            self.path.unlink(missing_ok=True)
        sync_folder(self.path.parent)


def _folder() -> Path:
    """Where programs of this user keep what they have to remember (XDG Base Directory Specification)."""
    given = Path(os.environ.get("XDG_STATE_HOME", ""))
    return (given if given.is_absolute() else Path.home() / ".local" / "state") / "physai"


def _why(error: Exception, path: Path) -> str:
    if not isinstance(error, OSError):
        return str(error)
    return f"{error.filename or path}: {error.strerror}"
