"""Who may look at a page, and who may command through it: decided when a browser connects, at its handshake.

viser lets everyone in, whatever page a browser's request comes from. Here a request must name this computer, and a
WebSocket must come from the page itself: else any page in a browser could open one (cross-site WebSocket hijacking), or
have a name of its own lead here (DNS rebinding). Who may not command is heard of its camera alone: viser would let any
message that names a button change or remove it, for everyone. Who may is remembered, and asked again at each command.
"""

import asyncio
import contextlib
import hmac
import http
import ipaddress
import logging
import socket
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

LOCAL = ("127.0.0.1", "localhost")
"""Addresses to listen on that only this computer's own programs can reach."""

_MOST = 16  # browsers at a time
_LARGEST = 2**20  # bytes of a message; those of viser's pages are far smaller

_WATCHING = {"ViewerCameraMessage"}
_COMMANDING = _WATCHING | {
    "GuiUpdateMessage",
    "TransformControlsDragStartMessage",
    "TransformControlsUpdateMessage",
    "TransformControlsDragEndMessage",
}
"""What is taken from browsers, by viser's names."""

Look = Callable[[ServerConnection, Request], Response | None]


@dataclass(frozen=True, eq=False)
class Visitor:
    """A connection that may command.

    Attributes:
        own: The task that serves the connection. What a browser sends is taken by others: so what happens in this one
            is viser tidying up after a browser that has gone.
    """

    own: "asyncio.Task[Any] | None"

    @property
    def gone(self) -> bool:
        """Whether its browser has gone, or is just being tidied up after."""
        return self.own is None or self.own.done() or self.own is asyncio.current_task()


_visitor: ContextVar[Visitor | None] = ContextVar("visitor", default=None)


def commander() -> Visitor | None:
    """Who has just sent what viser calls a coroutine for, if they may command; else None.

    A drag whose browser goes before it lets go is none of its commands, though viser tells it as one that has ended.
    """
    visitor = _visitor.get()
    return None if visitor is None or asyncio.current_task() is visitor.own else visitor


class Connection(ServerConnection):
    """Hears of a browser what it may say; whatever else comes is as if it had not come.

    Attributes:
        commands: Whether it may command.
    """

    commands = False

    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message that may pass."""
        while True:
            data = await super().recv(decode)
            if _passes(data, self.commands):
                return data


def _passes(data: Any, commands: bool) -> bool:
    try:
        message = msgspec.msgpack.decode(data)
        kind = message["type"]
        if kind == "GuiUpdateMessage" and set(message["updates"]) != {"value"}:
            return False
        return kind in (_COMMANDING if commands else _WATCHING)
    except (msgspec.MsgspecError, TypeError, KeyError, RecursionError):
        return False


@dataclass(frozen=True)
class Door:
    """Decides who gets in.

    Args:
        host: Where the page listens.
        commands: Whether anybody may command.
        token: What those must know who command; empty for everyone.
    """

    host: str
    commands: bool
    token: str = ""

    @property
    def local(self) -> bool:
        """Whether only this computer's own programs can reach it."""
        return self.host in LOCAL

    def knows(self, name: str) -> bool:
        """Whether a request for a host of this name is for us; elsewhere than here, numbers are as good as our name."""
        if name in (*LOCAL, self.host):
            return True
        own = socket.gethostname().lower()
        return not self.local and (name in (own, f"{own}.local") or _is_address(name))

    def refusal(self, host: str, origin: str | None) -> str | None:
        """Why a request is refused, or None.

        Args:
            host: Its header of this name: which page is asked for.
            origin: The same: which page asks, as browsers tell for WebSockets; None for other requests.
        """
        if not self.knows((urlsplit(f"//{host}").hostname or "").lower()):
            return "this page has another name"
        if origin is not None and origin.lower() != f"http://{host}".lower():
            return "a WebSocket must be opened by this page itself"
        return None

    def may_command(self, host: str, cookie: str) -> bool:
        """Whether who shows these headers may command."""
        if not self.commands or not self.token:
            return self.commands
        try:
            shown = SimpleCookie(cookie).get(_cookie(host))
        except CookieError:
            return False
        return shown is not None and self._is_token(shown.value)

    def _is_token(self, text: str) -> bool:
        return bool(self.token) and hmac.compare_digest(text.encode(), self.token.encode())

    def look(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request, or None if it may go on."""
        host, headers = request.headers.get("Host", ""), request.headers
        socket_wanted = "Upgrade" in headers
        reason = self.refusal(host, headers.get("Origin", "") if socket_wanted else None)
        if reason is not None:
            return _answer(http.HTTPStatus.FORBIDDEN, reason)
        if socket_wanted:
            if len(connection.server.connections) >= _MOST:
                return _answer(http.HTTPStatus.SERVICE_UNAVAILABLE, f"{_MOST} browsers look already")
            permitted = self.may_command(host, headers.get("Cookie", ""))
            _visitor.set(Visitor(asyncio.current_task()) if permitted else None)
            assert isinstance(connection, Connection)
            connection.commands = permitted
            return None
        if any(map(self._is_token, parse_qs(urlsplit(request.path).query).get("token", ()))):
            answer = _answer(http.HTTPStatus.SEE_OTHER, "")
            answer.headers["Location"] = "/"
            answer.headers["Set-Cookie"] = f"{_cookie(host)}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            return answer
        return None

    def before(self, serve_files: Look) -> Look:
        """Look at each request first, and keep other pages from framing what is served."""

        def look(connection: ServerConnection, request: Request) -> Response | None:
            answer = self.look(connection, request) or serve_files(connection, request)
            if answer is not None:
                answer.headers["Content-Security-Policy"] = "frame-ancestors 'none'"
                answer.headers["Referrer-Policy"] = "no-referrer"
            return answer

        return look


@contextlib.contextmanager
def guarding(door: Door) -> Iterator[None]:
    """Context in which a viser server must be made: the door stands before it from its first request on.

    viser offers no way to look at handshakes; but it calls ``serve`` of websockets, whose ``process_request`` does.

    Raises:
        RuntimeError: If no server was made in this way, as another viser might do.
    """
    original, made = websockets.asyncio.server.serve, []

    def serve(*args: Any, process_request: Look, **kwargs: Any) -> Any:
        made.append(True)
        before = door.before(process_request)
        kwargs |= {"process_request": before, "max_size": _LARGEST, "create_connection": Connection}
        return original(*args, **kwargs)

    websockets.asyncio.server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[misc]
    if not made:
        raise RuntimeError(
            "this viser does not start its server as physai.web.door expects, so that nobody is kept out"
        )
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL + 1)  # it tells of each request that is none


def _cookie(host: str) -> str:
    """Its name, of a page on this host: browsers keep cookies for all ports of a host together."""
    return f"physai_token_{urlsplit(f'//{host}').port or 80}"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _answer(status: http.HTTPStatus, text: str) -> Response:
    body = f"{text}\n".encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
    return Response(status, status.phrase, headers, body)
