"""Processes of their own that start quickly: the fork server of this session of tests, as its clients see it."""

import atexit
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

ROOT = Path(__file__).parent.parent
_PATIENCE = 120.0  # s, for what is imported at first


class Forge:
    """A connection to the fork server, which is shared by the workers of a session, and forks them, too.

    Args:
        path: The socket where it listens; None to start one.
    """

    def __init__(self, path: str | None = None) -> None:
        self._folder = None if path else tempfile.mkdtemp(prefix="physai-test-forge-")
        self.path = path or f"{self._folder}/socket"
        self.codes: dict[int, int] = {}
        self._popen = self._start() if self._folder else None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(self.path)
        self._started: list[int] = []
        self._gone = False
        self._lock = threading.Lock()
        self._told = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _start(self) -> subprocess.Popen[bytes]:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener, open(f"{self._folder}/log", "w") as log:
            listener.bind(self.path)
            listener.listen(64)  # clients may come before it has imported
            command = [sys.executable, "-m", "tests.fork_server"]
            return subprocess.Popen(
                command, stdin=listener, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True, cwd=ROOT
            )

    @property
    def pid(self) -> int | None:
        """Of the fork server, if this client started it."""
        return self._popen.pid if self._popen is not None else None

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while said := self._socket.recv(4096):
                what, pid, *code = said.decode().split()
                with self._told:
                    if what == "started":
                        self.codes.pop(int(pid), None)  # of another process that had its number
                        self._started.append(int(pid))
                    else:
                        self.codes[int(pid)] = int(code[0])
                    self._told.notify_all()
        with self._told:
            self._gone = True
            self._told.notify_all()

    def fork(
        self,
        module: str,
        arguments: Sequence[str],
        cwd: Path,
        env: Mapping[str, str],
        output: int,
        imported: bool = False,
        finalize: bool = False,
    ) -> int:
        """Run a module as ``python -m`` does, in a session of its own, and return its process id.

        Args:
            module: Its name.
            arguments: Behind it.
            cwd: Where.
            env: All of its environment.
            output: What becomes its standard output and error, a file descriptor.
            imported: Whether the module is imported, perhaps once for all, and its ``main`` called.
            finalize: Whether Python clears away all at the end, as it does elsewhere; it takes half a second.
        """
        order = {"module": module, "arguments": list(arguments), "cwd": str(cwd), "env": dict(env)}
        order |= {"imported": imported, "finalize": finalize}
        with self._lock, open(os.devnull) as nothing:
            count = len(self._started)
            socket.send_fds(self._socket, [json.dumps(order).encode()], [nothing.fileno(), output, output])
            with self._told:
                self._told.wait_for(lambda: len(self._started) > count or self._gone, _PATIENCE)
                assert len(self._started) > count, f"nothing was forked: {Path(self.path).with_name('log').read_text()}"
            return self._started[count]

    def ended(self, pid: int, timeout: float | None) -> bool:
        """Wait until a process has ended, and return whether it has."""
        with self._told:
            self._told.wait_for(lambda: pid in self.codes or self._gone, timeout)
            return pid in self.codes

    def close(self) -> None:
        """Leave, and wait until what was forked for this client has ended; whatever runs is killed."""
        with contextlib.suppress(OSError):  # it is gone
            self._socket.shutdown(socket.SHUT_WR)
        self._reader.join(10)
        self._socket.close()
        if self._popen is not None and self._folder is not None:
            self._popen.wait(10)
            shutil.rmtree(self._folder)


_forge: Forge | None = None


def forge() -> Forge:
    """Return the forge of this session; it starts with who asks first."""
    if _forge is None:
        share_forge(None)
        atexit.register(close_forge)
    assert _forge is not None
    return _forge


def share_forge(path: str | None) -> None:
    """Use the fork server that listens there."""
    global _forge
    _forge = Forge(path)


def close_forge() -> None:
    """At the end of a session."""
    global _forge
    if _forge is not None:
        _forge.close()
    _forge = None


class Forked:
    """A module that runs in a process of its own: of :class:`subprocess.Popen` what tests need.

    Args:
        module: Its name.
        arguments: Behind it.
        cwd: Where.
        env: All of its environment.
        finalize: Whether it ends as slowly as elsewhere (:meth:`Forge.fork`).
    """

    def __init__(
        self, module: str, arguments: Sequence[str], cwd: Path, env: Mapping[str, str], finalize: bool = False
    ) -> None:
        ours, theirs = os.pipe()
        self.stdout: IO[str] = os.fdopen(ours, encoding="utf-8")
        self._forge = forge()
        self.pid = self._forge.fork(module, arguments, cwd, env, theirs, finalize=finalize)
        os.close(theirs)

    @property
    def returncode(self) -> int | None:
        """As of ``Popen``."""
        return self._forge.codes.get(self.pid)

    def poll(self) -> int | None:
        """Return the exit code, or None while it runs."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit code, once it has ended."""
        if not self._forge.ended(self.pid, timeout):
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        return self._forge.codes[self.pid]

    def communicate(self, timeout: float | None = None) -> tuple[str, None]:
        """Return what it says until its end."""
        said: list[str] = []
        reader = threading.Thread(target=lambda: said.append(self.stdout.read()), daemon=True)
        began = time.monotonic()
        reader.start()
        reader.join(timeout)
        if reader.is_alive():
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        self.wait(None if timeout is None else max(0.1, timeout - (time.monotonic() - began)))
        return said[0], None

    def send_signal(self, number: int) -> None:
        """Send it a signal, if it is still there."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)
