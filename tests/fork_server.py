"""The fork server of a session of tests: it imports once what takes longest to import, and forks all else.

It listens at the socket that is its input. Each order that comes from there is a process to fork; who ordered it is
told when it has started and when it has ended. With a client end the processes that it has ordered, and with the last
client the server.
"""

import atexit
import contextlib
import ctypes
import functools
import gc
import importlib
import importlib.util
import json
import os
import runpy
import selectors
import signal
import socket
import sys
import threading
import types
from collections.abc import Sequence
from typing import Any, NoReturn

from physai.processes import die_with

# What workers of pytest, commands and nodes of ROS import, sooner or later; most of them run for less time than that.
IMPORTED = (
    *("physai.training.run", "physai.cli", "physai.algorithms", "physai.collectors", "physai.physics.pybullet"),
    *("physai.plots.curriculum", "physai.plots.runs", "physai.web.scene", "scipy.stats", "torch.utils.tensorboard"),
)
NODES = tuple(
    f"physai.ros.{node}" for node in ("inference_node", "virtual_robot", "record", "command_watchdog", "excite")
)
LARGEST = 1 << 20  # bytes of an order


class _Server:
    """Forks a process for each order, and tells of its end.

    Args:
        listener: Where clients come; one has come already, or will.
    """

    def __init__(self, listener: socket.socket) -> None:
        self._pid = os.getpid()
        self._listener = listener
        self._clients: set[socket.socket] = set()  # also those that have left, while processes of theirs are there
        self._children: dict[int, socket.socket] = {}
        self._woken, self._waking = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ, self._accept)
        self._selector.register(self._woken, selectors.EVENT_READ, self._reap)
        for end in (self._woken, self._waking):
            end.setblocking(False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(self._waking.fileno(), warn_on_full_buffer=False)

    def serve(self) -> None:
        """Serve until the last client has left."""
        self._accept()
        while self._clients:
            for key, _ in self._selector.select():
                key.data()

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        self._clients.add(client)
        self._selector.register(client, selectors.EVENT_READ, functools.partial(self._receive, client))

    def _receive(self, client: socket.socket) -> None:
        try:
            order, files, _, _ = socket.recv_fds(client, LARGEST, 3)
        except ConnectionError:
            order = b""
        if order:
            self._fork(client, order, files)
            return
        self._selector.unregister(client)
        for pid in self._of(client):
            os.kill(pid, signal.SIGKILL)
        self._close_idle(client)

    def _fork(self, client: socket.socket, order: bytes, files: Sequence[int]) -> None:
        pid = os.fork()
        if not pid:
            self._close_inherited()
            _become(json.loads(order), files, self._pid)
        for number in files:
            os.close(number)
        self._children[pid] = client
        self._send(client, f"started {pid}")

    def _reap(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._woken.recv(4096)
        while self._children:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                return
            client = self._children.pop(pid)
            self._send(client, f"ended {pid} {os.waitstatus_to_exitcode(status)}")
            if client not in self._selector.get_map():
                self._close_idle(client)

    def _of(self, client: socket.socket) -> list[int]:
        return [pid for pid, owner in self._children.items() if owner is client]

    def _close_idle(self, client: socket.socket) -> None:
        """Close what a client has left behind, once its processes have ended: until then, it waits for that."""
        if not self._of(client):
            self._clients.remove(client)
            client.close()

    def _send(self, client: socket.socket, line: str) -> None:
        with contextlib.suppress(ConnectionError):  # it has just left
            client.send(line.encode())

    def _close_inherited(self) -> None:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        self._selector.close()
        for one in (self._listener, self._woken, self._waking, *self._clients):
            one.close()


def _become(order: dict[str, Any], files: Sequence[int], server: int) -> NoReturn:
    """Be the process that was ordered; its standard files are those that came with the order."""
    die_with(server)
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell that started it in the background ignores it
    for target, number in enumerate(files):
        os.dup2(number, target)
    for number in set(files):
        os.close(number)
    os.environ.clear()
    os.environ.update(order["env"])
    os.chdir(order["cwd"])
    sys.modules["numpy"].random.seed()  # as in a Python of its own; others do so by themselves, or never
    try:
        _run(order)
        code: Any = 0
    except SystemExit as stop:
        code = 0 if stop.code is None else stop.code
        if order["finalize"] or not isinstance(code, int):  # words are for Python to print
            raise
    if order["finalize"]:
        sys.exit()
    _exit(code)


def _run(order: dict[str, Any]) -> None:
    if "code" in order:  # a worker
        sys.argv, sys.path[0] = ["-c"], ""
        sys.modules["__main__"] = main = types.ModuleType("__main__")
        exec(order["code"], vars(main))
        return
    sys.path[0] = order["cwd"]  # as for python -m
    sys.argv = [order["module"], *order["arguments"]]
    if order["imported"]:
        sys.exit(importlib.import_module(order["module"]).main())
    runpy.run_module(order["module"], run_name="__main__", alter_sys=True)


def _exit(code: int) -> NoReturn:
    """End as Python does, but do not clear away what is imported, which takes half a second."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
    except OSError:
        code = 120
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    ctypes.CDLL(None).fflush(None)  # what PyBullet prints
    os._exit(code % 256)


def _import() -> None:
    gc.disable()
    for module in (*IMPORTED, *(NODES if importlib.util.find_spec("rclpy") else ())):
        importlib.import_module(module)
    gc.freeze()  # no process looks for garbage in what is imported
    gc.enable()
    ctypes.CDLL(None).fflush(None)  # PyBullet has printed a line, of which no process shall hear


if __name__ == "__main__":
    with socket.socket(fileno=0) as standard_input:
        _import()
        _Server(standard_input).serve()
    _exit(0)
