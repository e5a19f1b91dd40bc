"""Shows robots in Foxglove, live: joint states, commands, goals, states, diagnostics, descriptions and transforms.

Open Foxglove, and connect it to the WebSocket that the log names. Whoever watches can send nothing to a robot. With
-p layout:=<file> a layout is written that Foxglove imports; it also shows recordings of physai.ros.record.
"""

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from physai.deploy.parameters import Parameters, parameter
from physai.errors import UserError
from physai.files import write_atomically
from physai.ros.node.run import StoppableNode, run
from physai.ros.record import TOPICS
from physai.ros.recording.listener import Listener
from physai.ros.topics import joint_states
from physai.ros.topics.description import LinkFrames

_DESCRIPTION = "/inference_node/robot_description"
_LATCHED = (_DESCRIPTION, "/state", "/estopped", "/goal")  # ends of topics: newcomers get their last message
_LOOK, _LOOK_AROUND, _GREET, _TRANSFORMS = 0.05, 0.25, 0.1, 0.03  # s


@dataclass(frozen=True)
class FoxgloveConfig(Parameters):
    """Parameters of the node."""

    host: str = parameter("127.0.0.1", "address to listen on; 0.0.0.0: every one of this computer", fixed=True)
    port: int = parameter(8765, "where to listen; 0: any that is free", "", 0, 65535, fixed=True)
    robots: str = parameter("all", "those of this namespace, or of all", choices=("own", "all"), fixed=True)
    topics: tuple[str, ...] = parameter(TOPICS, "what is shown", fixed=True)
    layout: str = parameter("", "file to write a layout for Foxglove to; empty: none", fixed=True)


class FoxgloveNode(StoppableNode[FoxgloveConfig]):
    """Passes on what robots say, and tells where their links are.

    Raises:
        UserError: If a parameter is wrong, or it cannot listen.
    """

    def __init__(self) -> None:
        super().__init__("foxglove", FoxgloveConfig)
        from physai.ros.live.stream import Stream  # foxglove-sdk need not be there

        config = self.config
        everywhere = config.robots == "all"
        self._robots: dict[str, LinkFrames] = {}  # by namespace
        self._names: dict[str, tuple[str, ...]] = {}  # of their joints, as their joint states have them
        self._told: dict[str, int] = {}  # when transforms were sent last, ns
        self._stream = Stream("physai", config.host, config.port)
        self._listener = Listener(self, config.topics, everywhere, self._take, self._stream.offer)
        self.every(_LOOK_AROUND if everywhere else _LOOK, self._listener.look)
        self.every(_GREET, self._stream.greet)
        self.get_logger().info(f"Foxglove can be connected to ws://{config.host}:{self._stream.port}")

    def _take(self, topic: str, kind: str, data: bytes, stamp: int) -> None:
        self._stream.send(topic, kind, data, stamp, latched=topic.endswith(_LATCHED))
        if topic.endswith(_DESCRIPTION) and kind == "std_msgs/msg/String":
            self._describe(topic.removesuffix(_DESCRIPTION), deserialize_message(data, String).data)
        elif topic.endswith(f"/{joint_states.TOPIC}") and kind == "sensor_msgs/msg/JointState":
            self._place(topic.removesuffix(f"/{joint_states.TOPIC}"), data, stamp)

    def _describe(self, namespace: str, urdf: str) -> None:
        try:
            self._robots[namespace] = LinkFrames(urdf)
        except ValueError as error:
            self.get_logger().warning(f"{namespace}{_DESCRIPTION}: {error}")
        self._write_layout()

    def _place(self, namespace: str, data: bytes, stamp: int) -> None:
        robot = self._robots.get(namespace)
        if robot is None or 0 <= stamp - self._told.get(namespace, 0) < _TRANSFORMS * 1e9:
            return
        self._told[namespace] = stamp
        message = deserialize_message(data, JointState)
        names = tuple(message.name)
        if len(names) == len(message.position):
            self._stream.send_transforms(robot.at(dict(zip(names, message.position, strict=True))), stamp)
        if names != self._names.get(namespace) and set(robot.joints) & set(names):
            self._names[namespace] = names
            self._write_layout()

    def _write_layout(self) -> None:
        if not self.config.layout:
            return
        from physai.ros.live.layout import layout

        robots = {
            name: (self._robots[name].base, self._names[name]) for name in sorted(self._robots) if name in self._names
        }
        try:
            write_atomically(Path(self.config.layout), layout(robots).encode())
        except OSError as error:
            raise UserError(f"layout: {error.filename or self.config.layout}: {error.strerror}") from error
        self.get_logger().info(f"{self.config.layout}: a layout for {len(robots)} robots")

    def finish(self) -> None:
        """Stop listening."""
        self._stream.close()


def main() -> int:
    """Run the node."""
    if importlib.util.find_spec("foxglove") is None:
        print("error: foxglove-sdk is not installed: pip install 'physai[foxglove]'", file=sys.stderr)
        return 2
    return run(FoxgloveNode, "physai.ros.foxglove", __doc__ or "", FoxgloveConfig)


if __name__ == "__main__":
    sys.exit(main())
