"""Nodes in processes of their own that start quickly."""

import contextlib
import os
import signal
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.forge import forge
from tests.ros.peer import Process, node_command
from tests.waiting import wait_for


class ForgedProcess(Process):
    """A node or a command of the forge."""

    def __init__(
        self,
        module: str,
        arguments: Sequence[str],
        domain: int,
        state: Path | None,
        output: Path | None = None,
        imported: bool = True,
        finalize: bool = False,
    ) -> None:
        self._forge = forge()
        self._folder = tempfile.TemporaryDirectory(prefix="physai-test-node-")
        self._log = Path(self._folder.name) / "log"
        self._log.touch()
        self._last: list[str] | None = None
        own = {"ROS_DOMAIN_ID": str(domain), "XDG_STATE_HOME": str(state or self._folder.name)}
        log = os.open(output or self._log, os.O_WRONLY | os.O_APPEND)
        self._pid = self._forge.fork(
            module, list(map(str, arguments)), Path.cwd(), os.environ | own, log, imported, finalize
        )
        os.close(log)

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
    module: str,
    domain: int,
    *args: str,
    state: Path | None = None,
    output: Path | None = None,
    finalize: bool = False,
    **parameters: Any,
) -> ForgedProcess:
    """Start a node: ``forged("inference_node", domain, policy_path=path)``.

    Args:
        module: Which one.
        domain: Its ROS domain.
        args: Behind --ros-args.
        state: Where it keeps what it remembers; None for nowhere else.
        output: Where its output goes, such as a terminal; None for where it is read.
        finalize: Whether it ends as slowly as elsewhere (:meth:`tests.forge.Forge.fork`).
        parameters: By name.
    """
    name = module if "." in module else f"physai.ros.{module}"
    return ForgedProcess(name, node_command(module, *args, **parameters)[3:], domain, state, output, finalize=finalize)
