"""A browser's place before the dashboard's page: it looks at the arms, and notes when it was shown what."""

import contextlib
import math
import threading
import time
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import viser
import zstandard
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

_HEADER = 16  # bytes before the compressed part of a frame; the last eight are its length
_SAME = 1e-4  # rad: viser does not even send such changes
_CAMERA = _messages.ViewerCameraMessage(
    (1.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 1.0, 0.1, 10.0, 100, 100, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
)


def look_at(host: str, port: int, **options: Any) -> ClientConnection:
    """Connect to one of viser's pages as its own script does, and say where one looks from: then it shows something.

    Args:
        host: Of the page.
        port: Of the page.
        **options: Of the connection, in the place of those of a browser.
    """
    as_browsers = {
        "origin": f"http://{host}:{port}",
        "subprotocols": [f"viser-v{viser.__version__}"],
        "max_size": None,
    }
    socket = connect(f"ws://{host}:{port}", **(as_browsers | options))
    socket.send(msgspec.msgpack.encode(_CAMERA.as_serializable_dict()))
    return socket


class Onlooker:
    """Looks at a page from now on, in a thread of its own, until it is closed.

    Args:
        host: Of the page.
        port: Of the page.
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket = look_at(host, port)
        self._frames: list[tuple[int, bytes]] = []
        threading.Thread(target=self._look, daemon=True).start()

    def _look(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            for frame in self._socket:
                assert isinstance(frame, bytes)
                self._frames.append((time.time_ns(), frame))

    def shown(self, arm: str) -> np.ndarray:
        """Return when its first joint was shown where, of an arm that turns it about the vertical.

        Args:
            arm: Its name on the page.

        Returns:
            ns since 1970 and rad, [n, 2].
        """
        name, found = f"/robot_{arm}/base/body1", []
        for at, frame in self._frames.copy():
            length = int.from_bytes(frame[_HEADER - 8 : _HEADER], "little")
            told = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(frame[_HEADER : _HEADER + length]))
            for message in told["messages"]:
                if message["type"] == "SetOrientationMessage" and message["name"] == name:
                    w, _, _, z = message["wxyz"]
                    found.append((at, 2 * math.atan2(z, w)))
        return np.array(found).reshape(-1, 2)

    def close(self) -> None:
        """Look away."""
        self._socket.close()


def ages(shown: np.ndarray, told: np.ndarray, moments: Sequence[int]) -> np.ndarray:
    """How old was what a page showed of a joint: since when has the robot not told of it any more.

    Args:
        shown: When it was shown where, ns and rad, [n, 2].
        told: When its robot told where it was, ns and rad, [m, 2].
        moments: Of interest, ns, [k].

    Returns:
        s, [k]; as old as everything where the page showed what the robot had not told.
    """
    found = []
    for moment in moments:
        now = np.searchsorted(shown[:, 0], moment, side="right")
        before = told[: np.searchsorted(told[:, 0], moment, side="right")]
        turn = before[:, 1] - (shown[now - 1, 1] if now else np.nan)
        same = np.flatnonzero(np.abs(np.angle(np.exp(1j * turn))) < _SAME)
        found.append(1e-9 * (moment - (before[same[-1], 0] if same.size else told[0, 0])))
    return np.array(found)
