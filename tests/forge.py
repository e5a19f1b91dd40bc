"""Processes of their own that start quickly: what takes longest to import is imported once, and forked.

Run as a program, it forks a process for each order that it reads, and tells when one has ended; they all end with it,
and it ends with its input.
"""

import contextlib
import ctypes
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from physai.processes import die_with

_LARGEST = 1 << 20  # bytes of an order
_PATIENCE = 120.0  # s, for what is imported at first


class Forge:
    """The forking process, as the tests see it.

    Args:
        modules: What it imports.
    """

    def __init__(self, modules: Sequence[str]) -> None:
        self._orders, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-m", "tests.forge", *modules]
        self._popen = subprocess.Popen(
            command, stdin=theirs, stdout=subprocess.PIPE, text=True, start_new_session=True, cwd=_ROOT
        )
        theirs.close()
        self._pids: list[int] = []
        self.codes: dict[int, int] = {}
        self._lock = threading.Lock()
        self._told = threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._popen.stdout:  # type: ignore[union-attr]
            what, pid, *code = line.split()
            with self._told:
                if what == "started":
                    self.codes.pop(int(pid), None)  # of another process that had its number
                    self._pids.append(int(pid))
                else:
                    self.codes[int(pid)] = int(code[0])
                self._told.notify_all()

    def fork(
        self,
        module: str,
        arguments: Sequence[str],
        cwd: Path,
        env: Mapping[str, str],
        output: int,
        imported: bool = False,
    ) -> int:
        """Run a module as ``python -m`` does, in a session of its own, and return its process id.

        Args:
            module: Its name.
            arguments: Behind it.
            cwd: Where.
            env: All of its environment.
            output: What becomes its standard output and error, a file descriptor.
            imported: Whether the module is imported, perhaps once for all, and its ``main`` called.
        """
        order = {"module": module, "arguments": list(arguments), "cwd": str(cwd), "env": dict(env), "main": imported}
        with self._lock:
            count = len(self._pids)
            socket.send_fds(self._orders, [json.dumps(order).encode()], [output])
            with self._told:
                assert self._told.wait_for(lambda: len(self._pids) > count, _PATIENCE), "nothing was forked"
            return self._pids[count]

    def ended(self, pid: int, timeout: float | None) -> bool:
        """Wait until a process has ended, and return whether it has."""
        with self._told:
            return self._told.wait_for(lambda: pid in self.codes, timeout)

    def close(self) -> None:
        """End it; its processes have ended before."""
        self._orders.close()
        self._popen.wait(10)


_ROOT = Path(__file__).parent.parent
_forges: dict[tuple[str, ...], Forge] = {}


def forge_of(*modules: str) -> Forge:
    """Return the forge of this session that has imported these modules."""
    if modules not in _forges:
        _forges[modules] = Forge(modules)
    return _forges[modules]


def close_forges() -> None:
    """At the end of a session."""
    while _forges:
        _forges.popitem()[1].close()


class Forked:
    """A module that runs in a process of its own: of :class:`subprocess.Popen` what tests need."""

    def __init__(self, forge: Forge, module: str, arguments: Sequence[str], cwd: Path, env: Mapping[str, str]) -> None:
        ours, theirs = os.pipe()
        self.stdout: IO[str] = os.fdopen(ours, encoding="utf-8")
        self._forge = forge
        self.pid = forge.fork(module, arguments, cwd, env, theirs)
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


def _report(*_: Any) -> None:
    """Tell who has ended; as a signal handler it must not use ``print``."""
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if not pid:
            return
        os.write(1, f"ended {pid} {os.waitstatus_to_exitcode(status)}\n".encode())


def _become(order: dict[str, Any], output: int, forge: int) -> None:
    die_with(forge)
    os.setsid()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    for number, target in ((os.open(os.devnull, os.O_RDONLY), 0), (output, 1), (output, 2)):
        os.dup2(number, target)
    os.close(output)
    os.environ.clear()
    os.environ.update(order["env"])
    os.chdir(order["cwd"])
    sys.path[0] = order["cwd"]  # as for python -m
    sys.argv = [order["module"], *order["arguments"]]
    if order["main"]:
        sys.exit(importlib.import_module(order["module"]).main())
    runpy.run_module(order["module"], run_name="__main__", alter_sys=True)
    sys.exit()


def _import(modules: Sequence[str]) -> None:
    """PyBullet prints a line, of which neither the tests nor each process shall hear."""
    stdout = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    gc.disable()
    for module in modules:
        importlib.import_module(module)
    gc.freeze()  # no process looks for garbage in what is imported
    gc.enable()
    ctypes.CDLL(None).fflush(None)
    os.dup2(stdout, 1)
    os.close(stdout)


def _forge(modules: Sequence[str]) -> None:
    _import(modules)
    forge, orders = os.getpid(), socket.socket(fileno=0)
    signal.signal(signal.SIGCHLD, _report)
    while True:
        data, outputs, _, _ = socket.recv_fds(orders, _LARGEST, 1)
        if not data:
            return
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])  # "started" comes first
        pid = os.fork()
        if not pid:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
            _become(json.loads(data), outputs[0], forge)
        os.close(outputs[0])
        os.write(1, f"started {pid}\n".encode())
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])


if __name__ == "__main__":
    _forge(sys.argv[1:])
