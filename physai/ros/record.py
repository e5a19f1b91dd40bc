"""Records what happens between an arm and its policy, as a rosbag2 folder (MCAP) for Foxglove, `ros2 bag` and rosbags.

Messages are kept as the wire has them, with the time at which they came. Ctrl-C ends a recording. After a kill it holds
all but the last tenth of a second, and is completed by -p recover:=<folder>.
"""

import sys
import time
from collections import OrderedDict, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from physai.deploy.parameters import Parameters, parameter
from physai.errors import UserError
from physai.ros.node.run import StoppableNode, brief, run
from physai.ros.recording.bag import TYPES, Bag, recover
from physai.ros.topics import commands, qos
from physai.signals import Quantity

TOPICS = (
    "/joint_states",
    commands.controller_topic(Quantity.JOINT_VELOCITY),
    commands.controller_topic(Quantity.JOINT_POSITION),
    "/command_watchdog/commands",
    "/inference_node/goal",
    "/inference_node/state",
    "/inference_node/estopped",
    "/emergency_stop",
    "/diagnostics",
)
_DEPTH = 10_000  # messages that may wait for this program
_LOOK, _FLUSH, _STATUS = 0.05, 0.1, 5.0  # s
_FOREVER = QosTime(9223372036, 854775807)


@dataclass(frozen=True)
class RecordConfig(Parameters):
    """Parameters of the recorder."""

    output: str = parameter("", "folder to make; empty: outputs/recording_<time>", fixed=True)
    topics: tuple[str, ...] = parameter(TOPICS, "what is recorded", fixed=True)
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
        self._topics = _resolve(self, config.topics)
        self._bag = Bag(Path(config.output or time.strftime("outputs/recording_%Y-%m-%d_%H-%M-%S")))
        self._heard: dict[tuple[Any, ...], Subscription | None] = {}
        self._recent: defaultdict[str, OrderedDict[tuple[int, int], None]] = defaultdict(OrderedDict)
        self.every(_LOOK, self._look)
        self.every(_FLUSH, self._flush)
        self.every(_STATUS, self._tell)
        if config.duration:
            self.every(config.duration, self._end)
        self.get_logger().info(f"recording {', '.join(self._topics)} to {self._bag.folder}")

    # Who publishes

    def _look(self) -> None:
        """Subscribe to each kind of publisher as it publishes: reliable ones reliably, latched ones from the past."""
        for topic in self._topics:
            for found in self.get_publishers_info_by_topic(topic):
                self._hear(topic, found.topic_type, found.qos_profile, str(found.topic_type_hash))
            # Who publishes once and goes waits for the first subscription, which need not be ours: be there before.
            for found in self.get_subscriptions_info_by_topic(topic):
                if not any(key[:2] == (topic, found.topic_type) for key in self._heard):
                    self._hear(topic, found.topic_type, QoSProfile(depth=10), str(found.topic_type_hash))

    def _hear(self, topic: str, kind: str, offered: QoSProfile, type_hash: str) -> None:
        key = (topic, kind, offered.reliability, offered.durability)
        if key not in self._heard:
            self._heard[key] = self._subscribe(topic, kind, offered, type_hash)

    def _subscribe(self, topic: str, kind: str, offered: QoSProfile, type_hash: str) -> Subscription | None:
        try:
            package, folder, name = kind.split("/")
            message = getattr(import_module(f"{package}.{folder}"), name)
        except (ValueError, ImportError, AttributeError):
            self.get_logger().warning(f"{topic} is not recorded: '{kind}' is not installed here")
            return None
        if kind not in TYPES.fielddefs:
            self.get_logger().warning(f"{topic} is not recorded: '{kind}' is no message of ROS 2 Jazzy")
            return None
        if type_hash not in (TYPES.hash_rihs01(kind), "INVALID"):  # other middlewares may have none
            self.get_logger().warning(f"{topic} is not recorded: '{kind}' is not that of ROS 2 Jazzy")
            return None
        # Publishers of other kinds on the topic are no fault: they have subscriptions of their own.
        return self.create_subscription(
            message,
            topic,
            partial(self._take, topic, kind),
            QoSProfile(depth=_DEPTH, reliability=offered.reliability, durability=offered.durability),
            event_callbacks=qos.SILENT_SUBSCRIPTION,
            raw=True,
        )

    # What they publish

    def _take(self, topic: str, kind: str, data: bytes, info: dict[str, int]) -> None:
        if self.code or self._seen(topic, info):
            return
        if (topic, kind) not in self._bag.connections:
            publishers = self.get_publishers_info_by_topic(topic)
            self._bag.add(topic, kind, [_to_bag(found.qos_profile) for found in publishers if found.topic_type == kind])
            self.get_logger().info(f"{topic}: the first message ({kind})")
        with self._ends_where_it_fails():
            self._bag.write(topic, kind, info["received_timestamp"] or time.time_ns(), data)

    def _seen(self, topic: str, info: dict[str, int]) -> bool:
        """Whether another subscription brought the same message: kinds of publishers overlap in whom they reach."""
        recent = self._recent[topic]
        key = (info["source_timestamp"], info["publication_sequence_number"])
        if key in recent:
            return True
        recent[key] = None
        if len(recent) > _DEPTH:
            recent.popitem(last=False)
        return False

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
        until = time.time_ns()
        for (topic, kind, *_), subscription in self._heard.items():
            if subscription is not None:
                self._drain(topic, kind, subscription, until)
        with self._ends_where_it_fails():
            self._bag.close()
        if self.code:
            return
        for topic in self._topics:
            self.get_logger().info(f"{topic}: {self._bag.counts[topic]:,} messages")
        self._tell()
        self.get_logger().info(f"recorded to {self._bag.folder}")

    def _drain(self, topic: str, kind: str, subscription: Subscription, until: int) -> None:
        with subscription.handle:
            while taken := subscription.handle.take_message(subscription.msg_type, True):
                data, info = taken
                if info["received_timestamp"] > until:
                    return
                self._take(topic, kind, data, info)


def _resolve(node: Recorder, topics: tuple[str, ...]) -> list[str]:
    """Full names, remapped as the user wants."""
    if not topics:
        raise UserError("topics: at least one is needed")
    try:
        return list(dict.fromkeys(node.resolve_topic_name(topic) for topic in topics))
    except RuntimeError as error:  # RCLError
        raise UserError(f"topics: {brief(error)}") from error


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
