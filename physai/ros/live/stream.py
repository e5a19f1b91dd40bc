"""ROS messages as channels of a Foxglove WebSocket server."""

import queue
from collections.abc import Sequence
from typing import Any

import foxglove
from foxglove import Channel, Context, Schema
from foxglove.channels import FrameTransformsChannel
from foxglove.messages import FrameTransform, FrameTransforms, Quaternion, Timestamp, Vector3
from foxglove.websocket import ServerListener

from physai.errors import UserError
from physai.ros.recording.bag import TYPES
from physai.ros.topics.description import Transform

TRANSFORMS = "/transforms"


class Stream:
    """Passes messages on to whoever watches; watchers can send nothing back.

    Nothing in it waits for a watcher: one that is too slow loses messages.

    Args:
        name: What watchers call it.
        host: An address of this computer.
        port: Where to listen; 0 takes a free one.

    Attributes:
        port: Where it listens.

    Raises:
        UserError: If it cannot listen there.
    """

    def __init__(self, name: str, host: str, port: int) -> None:
        self._context = Context()
        self._channels: dict[tuple[str, str], Channel] = {}
        self._latched: dict[int, tuple[Channel, bytes, int]] = {}  # the last message of a channel, by its id
        self._newcomers = _Newcomers()
        self._transforms = FrameTransformsChannel(TRANSFORMS, context=self._context)
        foxglove.set_log_level("ERROR")
        try:
            self._server = foxglove.start_server(
                name=name, host=host, port=port, context=self._context, server_listener=self._newcomers
            )
        except (RuntimeError, OSError, OverflowError) as error:
            raise UserError(f"cannot listen on {host}, port {port}: {error}") from error
        self.port: int = self._server.port

    def offer(self, topic: str, kind: str) -> None:
        """Have a channel before its first message, which watchers would miss else.

        Args:
            topic: Its topic.
            kind: The type of its messages, one of :data:`physai.ros.recording.bag.TYPES`.
        """
        if (topic, kind) not in self._channels:
            schema = Schema(name=kind, encoding="ros2msg", data=TYPES.generate_msgdef(kind)[0].encode())
            channel = Channel(topic, schema=schema, message_encoding="cdr", context=self._context)
            self._channels[topic, kind] = channel

    def send(self, topic: str, kind: str, data: bytes, stamp: int, latched: bool = False) -> None:
        """Pass a message on.

        Args:
            topic: Its topic, which was offered before.
            kind: Its type.
            data: Its CDR, as the wire has it.
            stamp: When it came, ns since 1970.
            latched: Whether those who come later get it, too.
        """
        channel = self._channels[topic, kind]
        channel.log(data, log_time=stamp)
        if latched:
            self._latched[channel.id()] = channel, data, stamp

    def send_transforms(self, transforms: Sequence[Transform], stamp: int) -> None:
        """Tell where links are, at a time, ns since 1970."""
        at = Timestamp(*divmod(stamp, 10**9))
        told = [_message(transform, at) for transform in transforms]
        self._transforms.log(FrameTransforms(transforms=told), log_time=stamp)

    def greet(self) -> None:
        """Tell those who have just come what was said last on latched topics; the others hear it again."""
        for channel_id in self._newcomers.take():
            if channel_id in self._latched:
                channel, data, stamp = self._latched[channel_id]
                channel.log(data, log_time=stamp)

    def close(self) -> None:
        """Stop listening."""
        self._server.stop()


class _Newcomers(ServerListener):
    """Remembers which channels somebody has begun to watch; it is called from threads of the server."""

    def __init__(self) -> None:
        self._channels: queue.SimpleQueue[int] = queue.SimpleQueue()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self._channels.put(channel.id)

    def take(self) -> set[int]:
        return {self._channels.get() for _ in range(self._channels.qsize())}


def _message(transform: Transform, at: Timestamp) -> FrameTransform:
    (x, y, z), (qx, qy, qz, qw) = transform.position, transform.orientation
    return FrameTransform(
        timestamp=at,
        parent_frame_id=transform.parent,
        child_frame_id=transform.child,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
    )
