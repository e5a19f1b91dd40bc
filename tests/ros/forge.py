"""Nodes in processes of their own that start quickly: torch and rclpy, which take longest, are imported once.

Run as a program, it forks a process for each line of JSON that it reads, and tells when it has ended; they all end with
it, and it ends with its input.
"""

import contextlib
import ctypes
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from physai.processes import die_with
from tests.ros.peer import Process, node_command, wait_for

NODES = ("inference_node", "virtual_robot", "record", "command_watchdog", "excite")


class Forge:
    """The forking process, as the tests see it."""

    def __init__(self) -> None:
        self._popen = subprocess.Popen(
            [sys.executable, "-m", "tests.ros.forge"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self.pids: list[int] = []
        self.codes: dict[int, int] = {}
        self._lock = threading.Lock()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._popen.stdout:  # type: ignore[union-attr]
            what, pid, *code = line.split()
            if what == "started":
                self.pids.append(int(pid))
            else:
                self.codes[int(pid)] = int(code[0])

    def fork(self, order: dict[str, Any]) -> int:
        """Start a node, and return its process id."""
        with self._lock:
            count = len(self.pids)
            print(json.dumps(order), file=self._popen.stdin, flush=True)
            wait_for(lambda: len(self.pids) > count, 60.0, "a forked process")
            return self.pids[count]

    def close(self) -> None:
        """End it; its nodes have ended before."""
        self._popen.stdin.close()  # type: ignore[union-attr]
        self._popen.wait(10)


_forges: list[Forge] = []


class ForgedProcess(Process):
    """A node of a forge."""

    def __init__(
        self, module: str, arguments: Sequence[str], domain: int, state: Path | None, output: Path | None
    ) -> None:
        if not _forges:
            _forges.append(Forge())
        self._forge = _forges[0]
        self._folder = tempfile.TemporaryDirectory(prefix="physai-test-node-")
        self._log = Path(self._folder.name) / "log"
        self._log.touch()
        self._last: list[str] | None = None
        order = {
            "module": module,
            "arguments": list(map(str, arguments)),
            "domain": domain,
            "log": str(output or self._log),
            "state": str(state or self._folder.name),  # no other test's emergency stop
        }
        self._pid = self._forge.fork(order)

    @property
    def lines(self) -> list[str]:  # type: ignore[override]
        return self._last if self._last is not None else self._log.read_text().splitlines()

    @property
    def pid(self) -> int:
        return self._pid

    def poll(self) -> int | None:
        return self._forge.codes.get(self._pid)

    def signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(self._pid, number)

    def wait(self, timeout: float = 60.0) -> int:
        wait_for(lambda: self.poll() is not None, timeout, f"an end of\n{self.output}")
        return self._forge.codes[self._pid]

    def end(self) -> None:
        self.signal(signal.SIGCONT)
        self.signal(signal.SIGTERM)
        try:
            self.wait(5)
        except AssertionError:
            self.signal(signal.SIGKILL)
            self.wait(10)
        self._last = self.lines
        self._folder.cleanup()


def forged(
    module: str, domain: int, *args: str, state: Path | None = None, output: Path | None = None, **parameters: Any
) -> ForgedProcess:
    """Start a node: ``forged("inference_node", domain, policy_path=path)``.

    Args:
        module: Which one.
        domain: Its ROS domain.
        args: Behind --ros-args.
        state: Where it keeps what it remembers; None for nowhere else.
        output: Where its output goes, such as a terminal; None for where it is read.
        parameters: By name.
    """
    name = module if "." in module else f"physai.ros.{module}"
    return ForgedProcess(name, node_command(module, *args, **parameters)[3:], domain, state, output)


def close_forges() -> None:
    """At the end of a session."""
    while _forges:
        _forges.pop().close()


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


def _become(order: dict[str, Any], forge: int) -> None:
    die_with(forge)
    os.setsid()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    log = os.open(order["log"], os.O_WRONLY | os.O_APPEND)
    for number, target in ((os.open(os.devnull, os.O_RDONLY), 0), (log, 1), (log, 2)):
        os.dup2(number, target)
    os.environ["ROS_DOMAIN_ID"] = str(order["domain"])
    os.environ["XDG_STATE_HOME"] = order["state"]
    sys.argv = [order["module"], *order["arguments"]]
    sys.exit(importlib.import_module(order["module"]).main())


def _import() -> None:
    """What nodes need; PyBullet prints a line, of which neither the tests nor each node shall hear."""
    stdout = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    nodes = (f"physai.ros.{node}" for node in NODES)
    for module in (*nodes, "physai.physics.pybullet"):  # a virtual robot's engine, which it imports by its name
        importlib.import_module(module)
    ctypes.CDLL(None).fflush(None)
    os.dup2(stdout, 1)


def _forge() -> None:
    _import()
    forge = os.getpid()
    signal.signal(signal.SIGCHLD, _report)
    for line in iter(sys.stdin.readline, ""):
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])  # "started" comes first
        pid = os.fork()
        if not pid:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
            _become(json.loads(line), forge)
        os.write(1, f"started {pid}\n".encode())
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])


if __name__ == "__main__":
    _forge()
