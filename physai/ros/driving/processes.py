"""Nodes in processes of their own, which end with this one."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

from physai.processes import die_with

_PATIENCE = 5.0  # s


class NodeProcess:
    """A node of physai; as a context manager it ends with the block, by SIGTERM, so that it leaves the arm standing.

    Args:
        module: Such as ``physai.ros.virtual_robot``.
        log: Where its output goes; what it has to remember is kept beside.
        parameters: ROS parameters by name.
    """

    def __init__(self, module: str, log: Path, **parameters: object) -> None:
        self.module = module
        self.log = log
        command = [sys.executable, "-m", module, "--ros-args"]
        for name, value in parameters.items():
            command += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
        with open(log, "w") as output:
            self._process = subprocess.Popen(
                command,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "XDG_STATE_HOME": str(log.parent.absolute())},  # no other robot's emergency stop
                preexec_fn=partial(die_with, os.getpid(), signal.SIGTERM),
                start_new_session=True,  # Ctrl-C is for this program, which ends its nodes in their order
            )
        self.pid = self._process.pid

    @property
    def ended(self) -> bool:
        """Whether it has ended."""
        return self._process.poll() is not None

    def last_words(self) -> str:
        """The last line of its output."""
        lines = [line for line in self.log.read_text(errors="replace").splitlines() if line.strip()]
        return lines[-1] if lines else "no output"

    def __enter__(self) -> "NodeProcess":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Have it end, and wait for it."""
        self._process.terminate()
        try:
            self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
