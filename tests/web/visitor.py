"""A client of viser's pages that says whatever it likes, as no browser would."""

import contextlib
from typing import Any

import msgspec
import zstandard
from viser import _messages

from physai.bench.onlooker import look_at


class Visitor:
    """Connected to a page, and looking at it.

    Args:
        host: Of the page.
        port: Of the page.
        origin: The page that it claims to be.
        cookie: What it shows.
        **options: Of the connection.
    """

    def __init__(self, host: str, port: int, origin: str | None = None, cookie: str = "", **options: Any) -> None:
        as_claimed = {"origin": origin} if origin else {}
        cookies = {"additional_headers": {"Cookie": cookie}} if cookie else {}
        self.socket = look_at(host, port, **as_claimed, **cookies, **options)

    def say(self, message: Any) -> None:
        self.socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    def press(self, button: str) -> None:
        """Press the button with this id."""
        self.say(_messages.GuiUpdateMessage(button, {"value": True}))

    def drag(self, name: str, *positions: tuple[float, float, float], release: bool = True) -> None:
        """Drag what has this name in the scene along positions."""
        self.say(_messages.TransformControlsDragStartMessage(name))
        for position in positions:
            self.say(_messages.TransformControlsUpdateMessage(name, (1.0, 0.0, 0.0, 0.0), position))
        if release:
            self.say(_messages.TransformControlsDragEndMessage(name))

    def close(self) -> None:
        self.socket.close()


def shows(visitor: Visitor, name: str) -> bool:
    """Whether what has this name in the scene is among what the page sends now."""
    with contextlib.suppress(TimeoutError):
        while True:
            if name.encode() in _unpacked(visitor.socket.recv(timeout=0.1)):
                return True
    return False


def _unpacked(frame: Any) -> bytes:
    size = int.from_bytes(frame[8:16], "little")
    return zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size])
