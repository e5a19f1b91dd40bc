"""Processes of their own that start quickly: what takes longest to import is imported once, and forked.

A session of tests has one forge, which all of its workers share, and which forks them, too. Run as a program, it
listens at the socket that is its input, forks a process for each order that comes from there, and tells when one has
ended. With a worker end the processes that it has ordered, and with the last worker the forge.
"""

import atexit
import contextlib
import ctypes
import functools
import gc
import importlib
import json
import os
import runpy
import selectors
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from physai.processes import die_with

ROOT = Path(__file__).parent.parent
# What workers, commands and nodes of ROS import, sooner or later, which takes longer than most of them run.
IMPORTED = (
    *("physai.training.run", "physai.cli", "physai.algorithms", "physai.collectors", "physai.physics.pybullet"),
    *("physai.plots.curriculum", "physai.plots.runs", "scipy.stats", "torch.utils.tensorboard"),
    *("physai.ros.inference_node", "physai.ros.virtual_robot", "physai.ros.record", "physai.ros.command_watchdog"),
    *("physai.ros.excite", "physai.web.scene"),
)
_LARGEST = 1 << 20  # bytes of an order
_PATIENCE = 120.0  # s, for what is imported at first


class Forge:
    """The forge, as one of its clients sees it.

    Args:
        path: The socket where it listens; None to start one.
    """

    def __init__(self, path: str | None = None) -> None:
        self._folder = None if path else tempfile.mkdtemp(prefix="physai-test-forge-")
        self.path = path or f"{self._folder}/forge"
        self.codes: dict[int, int] = {}
        self._popen = self._start() if self._folder else None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(self.path)
        self._started: list[int] = []
        self._gone = False
        self._lock = threading.Lock()
        self._told = threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()

    def _start(self) -> subprocess.Popen[bytes]:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            listener.bind(self.path)
            listener.listen(64)  # clients may come before it has imported
            command = [sys.executable, "-m", "tests.forge"]
            return subprocess.Popen(
                command, stdin=listener, stdout=subprocess.DEVNULL, start_new_session=True, cwd=ROOT
            )

    @property
    def pid(self) -> int | None:
        """Of the forge, if this client started it."""
        return self._popen.pid if self._popen is not None else None

    def _read(self) -> None:
        while said := self._socket.recv(_LARGEST):
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
        with self._lock, open(os.devnull) as nothing:
            count = len(self._started)
            socket.send_fds(self._socket, [json.dumps(order).encode()], [nothing.fileno(), output, output])
            with self._told:
                self._told.wait_for(lambda: len(self._started) > count or self._gone, _PATIENCE)
                assert len(self._started) > count, "nothing was forked"
            return self._started[count]

    def ended(self, pid: int, timeout: float | None) -> bool:
        """Wait until a process has ended, and return whether it has."""
        with self._told:
            self._told.wait_for(lambda: pid in self.codes or self._gone, timeout)
            return pid in self.codes

    def close(self) -> None:
        """Leave it: what it has forked for this client has ended, or ends now."""
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        if self._popen is not None and self._folder is not None:
            self._popen.wait(10)
            shutil.rmtree(self._folder)


_forge: Forge | None = None


def forge() -> Forge:
    """Return the forge of this session; it starts with who asks first."""
    global _forge
    if _forge is None:
        _forge = Forge()
    return _forge


def share_forge(path: str) -> None:
    """Use the forge that listens there."""
    global _forge
    _forge = Forge(path)


def close_forge() -> None:
    """At the end of a session."""
    global _forge
    if _forge is not None:
        _forge.close()
    _forge = None


class Forked:
    """A module that runs in a process of its own: of :class:`subprocess.Popen` what tests need."""

    def __init__(self, module: str, arguments: Sequence[str], cwd: Path, env: Mapping[str, str]) -> None:
        ours, theirs = os.pipe()
        self.stdout: IO[str] = os.fdopen(ours, encoding="utf-8")
        self._forge = forge()
        self.pid = self._forge.fork(module, arguments, cwd, env, theirs)
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


def _become(order: dict[str, Any], files: Sequence[int], forge: int) -> None:
    """Be the process that was ordered; its standard files are those that came with the order."""
    die_with(forge)
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell that started it in the background ignores it
    for target, number in enumerate(files):
        os.dup2(number, target)
    for number in set(files):
        os.close(number)
    os.environ.clear()
    os.environ.update(order["env"])
    os.chdir(order["cwd"])
    try:
        _run(order)
    except SystemExit as stop:
        if stop.code is None or isinstance(stop.code, int):  # words are for Python to print
            _leave_with(stop.code or 0)
        raise


def _run(order: dict[str, Any]) -> None:
    if "code" in order:  # a worker
        sys.argv, sys.path[0] = ["-c"], ""
        sys.modules["__main__"] = main = types.ModuleType("__main__")
        exec(order["code"], vars(main))
        sys.exit()
    sys.path[0] = order["cwd"]  # as for python -m
    sys.argv = [order["module"], *order["arguments"]]
    if order["main"]:
        sys.exit(importlib.import_module(order["module"]).main())
    runpy.run_module(order["module"], run_name="__main__", alter_sys=True)
    sys.exit()


def _leave_with(code: int | None) -> None:
    """Choose the exit code; with one, nobody clears away what is imported, which takes Python half a second."""
    global _code
    _code = code


def _leave() -> None:
    if _code is not None:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):  # nobody reads it any more, or it is closed
                stream.flush()
        os._exit(_code % 256)


_code: int | None = None


class _Smithy:
    """What the forge itself does: take orders, fork, and tell of ends."""

    def __init__(self, listener: socket.socket) -> None:
        self._pid = os.getpid()
        self._listener = listener
        self._children: dict[int, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ, self._welcome)
        self._ends, written = socket.socketpair()
        self._written = written
        for end in (self._ends, written):
            end.setblocking(False)
        self._selector.register(self._ends, selectors.EVENT_READ, self._report)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(written.fileno(), warn_on_full_buffer=False)
        self._clients: set[socket.socket] = set()

    def serve(self) -> None:
        """Until the last client has left."""
        self._welcome()
        while self._clients:
            for key, _ in self._selector.select():
                key.data()

    def _welcome(self) -> None:
        client, _ = self._listener.accept()
        self._clients.add(client)
        self._selector.register(client, selectors.EVENT_READ, functools.partial(self._obey, client))

    def _obey(self, client: socket.socket) -> None:
        try:
            data, files, _, _ = socket.recv_fds(client, _LARGEST, 3)
        except ConnectionResetError:
            data = b""
        if not data:
            self._selector.unregister(client)
            self._clients.remove(client)
            client.close()
            for pid in [pid for pid, owner in self._children.items() if owner is client]:
                os.kill(pid, signal.SIGKILL)
            return
        pid = os.fork()
        if not pid:
            self._forget()
            _become(json.loads(data), files, self._pid)
        for number in files:
            os.close(number)
        self._children[pid] = client
        self._tell(client, f"started {pid}")

    def _report(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._ends.recv(_LARGEST)
        while self._children:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                return
            self._tell(self._children.pop(pid), f"ended {pid} {os.waitstatus_to_exitcode(status)}")

    def _tell(self, client: socket.socket, line: str) -> None:
        if client in self._clients:
            with contextlib.suppress(BrokenPipeError):  # it has just left
                client.send(line.encode())

    def _forget(self) -> None:
        """In the new process, which has no business with any of these."""
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        self._selector.close()
        for one in (self._listener, self._ends, self._written, *self._clients):
            one.close()


def _import() -> None:
    """PyBullet prints a line, of which neither the tests nor each process shall hear."""
    gc.disable()
    for module in IMPORTED:
        importlib.import_module(module)
    gc.freeze()  # no process looks for garbage in what is imported
    gc.enable()
    ctypes.CDLL(None).fflush(None)


if __name__ == "__main__":
    atexit.register(_leave)  # the first, so that it comes last
    with socket.socket(fileno=0) as socket_here:
        _import()
        _Smithy(socket_here).serve()
    _leave_with(0)
