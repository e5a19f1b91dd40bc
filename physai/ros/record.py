"""Records what happens between an arm and its policy, as a rosbag2 folder (MCAP) for Foxglove, `ros2 bag` and rosbags.

Messages are kept as the wire has them, with the time at which they came. Ctrl-C ends a recording. After a kill it holds
all but the last tenth of a second, and is completed by -p recover:=<folder>.
"""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rclpy.qos import QoSProfile
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from physai.deploy.parameters import Parameters, parameter
from physai.errors import UserError
from physai.ros.node.run import StoppableNode, run
from physai.ros.recording.bag import Bag, recover
from physai.ros.recording.listener import Listener
from physai.ros.topics import commands, emergency_stop, joint_states
from physai.signals import Quantity

TOPICS = (
    joint_states.TOPIC,
    commands.controller_topic(Quantity.JOINT_VELOCITY),
    commands.controller_topic(Quantity.JOINT_POSITION),
    "command_watchdog/commands",
    "inference_node/goal",
    "inference_node/cmd_vel",
    "imu",
    "odom",
    "inference_node/state",
    "inference_node/estopped",
    "inference_node/robot_description",
    *emergency_stop.TOPICS,
    "/diagnostics",
)
_LOOK, _FLUSH, _STATUS = 0.05, 0.1, 5.0  # s
_LOOK_AROUND = 0.25  # s; in all namespaces, which are many to look at
_FOREVER = QosTime(9223372036, 854775807)


@dataclass(frozen=True)
class RecordConfig(Parameters):
    """Parameters of the recorder."""

    output: str = parameter("", "folder to make; empty: outputs/recording_<time>", fixed=True)
    topics: tuple[str, ...] = parameter(TOPICS, "what is recorded", fixed=True)
    robots: str = parameter(
        "own",
        "those of this namespace, or of all: topics are looked for in every one",
        choices=("own", "all"),
        fixed=True,
    )
    duration: float = parameter(0.0, "ends by itself after this; 0: at Ctrl-C", "s", 0.0, 1e9, fixed=True)
    recover: str = parameter("", "recording of a killed recorder: complete it, and do nothing else", fixed=True)


class Recorder(StoppableNode[RecordConfig]):
    """Writes down every message of some topics, once.

    Raises:
        UserError: If a parameter is wrong or the folder cannot be made.
    """

    def __init__(self) -> None:
        super().__init__("recorder", RecordConfig)
        config = self.config
        if config.recover:
            count = recover(Path(config.recover))
            self.get_logger().info(f"{config.recover} is complete: {count:,} messages")
            self.stopped = True
            return
        everywhere = config.robots == "all"
        self._listener = Listener(self, config.topics, everywhere, self._take)
        self._bag = Bag(Path(config.output or time.strftime("outputs/recording_%Y-%m-%d_%H-%M-%S")))
        self.every(_LOOK_AROUND if everywhere else _LOOK, self._listener.look)
        self.every(_FLUSH, self._flush)
        self.every(_STATUS, self._tell)
        if config.duration:
            self.every(config.duration, self._end)
        whose = ", of all robots," if everywhere else ""
        self.get_logger().info(f"recording {', '.join(self._listener.topics)}{whose} to {self._bag.folder}")

    def _take(self, topic: str, kind: str, data: bytes, stamp: int) -> None:
        if self.code:
            return
        if (topic, kind) not in self._bag.connections:
            publishers = self.get_publishers_info_by_topic(topic)
            self._bag.add(topic, kind, [_to_bag(found.qos_profile) for found in publishers if found.topic_type == kind])
            self.get_logger().info(f"{topic}: the first message ({kind})")
        with self._ends_where_it_fails():
            self._bag.write(topic, kind, stamp, data)

    def _flush(self) -> None:
        if not self.code:
            with self._ends_where_it_fails():
                self._bag.flush()

    def _tell(self) -> None:
        self.get_logger().info(f"{self._bag.counts.total():,} messages, {self._bag.size / 1e6:.1f} MB")

    # The end

    def _end(self) -> None:
        self.stopped = True

    @contextmanager
    def _ends_where_it_fails(self) -> Iterator[None]:
        try:
            yield
        except UserError as error:
            self.code, self.stopped = 1, True
            self.get_logger().fatal(f"{error}; -p recover:={self._bag.folder} completes what is there")

    def finish(self) -> None:
        """Take what has arrived until now, and complete the recording."""
        if self.config.recover or self.code:
            return
        self._listener.drain()
        with self._ends_where_it_fails():
            self._bag.close()
        if self.code:
            return
        for topic in self._listener.topics:
            self.get_logger().info(f"{topic}: {self._bag.counts[topic]:,} messages")
        self._tell()
        self.get_logger().info(f"recorded to {self._bag.folder}")


def _to_bag(offered: QoSProfile) -> Qos:
    """What players need to know; nobody can ask a publisher for its depth."""
    return Qos(
        QosHistory.KEEP_LAST,
        offered.depth or 10,
        QosReliability(int(offered.reliability)),
        QosDurability(int(offered.durability)),
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )


def main() -> int:
    """Run the node."""
    return run(Recorder, "physai.ros.record", __doc__ or "", RecordConfig)


if __name__ == "__main__":
    sys.exit(main())
