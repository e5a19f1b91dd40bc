"""A page in the browser for the robots of a domain: each as an arm in 3-D, with its state in words, goals and plots.

It finds every inference node, whatever its namespace. On the page a goal can be dragged, a robot enabled, reset and
stopped, and all of them be stopped. The page is a convenience and holds no safety; if it ends, no robot hears of it.
"""

import importlib.util
import os
import secrets
import socket
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physai.config import not_installed
from physai.deploy.parameters import Parameters, parameter
from physai.errors import UserError
from physai.ros.node.run import StoppableNode, run

_LOOK = 0.5  # s
_NICE = 10  # robots come first
_SHORTEST = 16  # characters of a token


@dataclass(frozen=True)
class DashboardConfig(Parameters):
    """Parameters of the node."""

    host: str = parameter("127.0.0.1", "address to listen on; 0.0.0.0: every one of this computer", fixed=True)
    port: int = parameter(8090, "where to listen; 0: any that is free", "", 0, 65535, fixed=True)
    commands: str = parameter(
        "auto",
        "whether the page may command; auto: where only this computer reaches it",
        choices=("auto", "true", "false"),
        fixed=True,
    )
    token_file: str = parameter(
        "", "file with the token of those who may command from elsewhere; empty: a new one at each start", fixed=True
    )

    def __post_init__(self) -> None:
        if isinstance(self.commands, bool):  # ROS reads true and false as such
            object.__setattr__(self, "commands", str(self.commands).lower())
        super().__post_init__()


class DashboardNode(StoppableNode[DashboardConfig]):
    """Listens to robots, and serves the page; what is asked there is done here.

    Raises:
        UserError: If a parameter is wrong, or it cannot listen.
    """

    def __init__(self) -> None:
        super().__init__("dashboard", DashboardConfig)
        from physai.ros.live.page import Page  # viser need not be there
        from physai.ros.live.robots import Robots
        from physai.web.door import LOCAL, Door
        from physai.web.server import serve

        config = self.config
        local = config.host in LOCAL
        commands = local if config.commands == "auto" else config.commands == "true"
        token = "" if local or not commands else _token(config.token_file)
        door = Door(config.host, commands, token)
        self._robots = Robots(self, commands)
        self._serving: Any = serve(config.host, config.port, "physai: robots", 2.0, -0.02, door)
        server = self._serving.__enter__()
        self._ended = threading.Event()
        page = Page(server, door, self._robots)
        self._page = threading.Thread(target=self._show, args=(page,), name="page", daemon=True)
        self._page.start()
        self.every(_LOOK, self._robots.look)
        self._welcome(door, server.get_port())

    def _show(self, page: Any) -> None:
        try:
            page.run(self._ended)
        except Exception as error:
            self.get_logger().fatal(f"the page ends: {type(error).__name__}: {error}")
            self.stopped, self.code = True, 1

    def _welcome(self, door: Any, port: int) -> None:
        """Say who gets in; the token only on the terminal, for the log goes to everyone on ROS."""
        host = socket.gethostname() if door.host == "0.0.0.0" else door.host
        page = f"http://{host}:{port}"
        who = "the browsers of this computer" if door.local else "everyone who reaches this address"
        if door.token:
            self.get_logger().info(f"{page}: {who} may watch; who has the token may command (its address: see stdout)")
            print(f"To command: {page}/?token={door.token}", flush=True)
        elif door.commands:
            self.get_logger().info(f"{page}: {who} may watch and command")
        else:
            self.get_logger().info(f"{page}: {who} may watch; nobody may command")

    def finish(self) -> None:
        """Stop listening; robots hear nothing of it."""
        self._ended.set()
        self._page.join(2.0)
        self._serving.__exit__(None, None, None)


def _token(path: str) -> str:
    if not path:
        return secrets.token_urlsafe(24)
    try:
        token = Path(path).read_text(encoding="ascii").strip()
    except (OSError, UnicodeError) as error:
        raise UserError(f"token_file: {path}: {getattr(error, 'strerror', None) or 'not plain text'}") from error
    if len(token) < _SHORTEST or not all(letter.isalnum() or letter in "-_" for letter in token):
        raise UserError(f"token_file: {path}: needs at least {_SHORTEST} letters, digits, - or _, and nothing else")
    return token


def main() -> int:
    """Run the node."""
    if importlib.util.find_spec("viser") is None:
        print(f"error: the dashboard needs {not_installed('viser')}", file=sys.stderr)
        return 2
    os.nice(_NICE)
    return run(DashboardNode, "physai.ros.dashboard", __doc__ or "", DashboardConfig)


if __name__ == "__main__":
    sys.exit(main())
