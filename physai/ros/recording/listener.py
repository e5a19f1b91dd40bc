"""Hearing all that is said on some topics, once and as the wire has it, however the publishers publish."""

import time
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from physai.errors import UserError
from physai.ros.node.run import brief
from physai.ros.recording.bag import TYPES
from physai.ros.topics import qos

_DEPTH = 10_000  # messages that may wait for this program

Take = Callable[[str, str, bytes, int], None]


class Listener:
    """Listens to topics, those that will be there later, too.

    Args:
        node: Whose subscriptions they are; it calls :meth:`look` now and then.
        topics: Their names; relative ones are in the node's namespace.
        everywhere: Whether the same topics are heard in all other namespaces, too.
        take: Called with each message: topic, type, CDR, and the time at which it came, ns since 1970.
        found: Called with topic and type as soon as somebody publishes or awaits such messages.

    Attributes:
        topics: Full names of those that are listened to.

    Raises:
        UserError: If a name is none, or there are none.
    """

    def __init__(
        self,
        node: Node,
        topics: Sequence[str],
        everywhere: bool,
        take: Take,
        found: Callable[[str, str], None] = lambda topic, kind: None,
    ) -> None:
        if not topics:
            raise UserError("topics: at least one is needed")
        try:
            self.topics = list(dict.fromkeys(node.resolve_topic_name(topic) for topic in topics))
        except RuntimeError as error:  # RCLError
            raise UserError(f"topics: {brief(error)}") from error
        self._endings = tuple(f"/{topic.lstrip('/')}" for topic in topics) if everywhere else ()
        self._node = node
        self._pass_on = take
        self._found = found
        self._heard: dict[tuple[Any, ...], Subscription | None] = {}
        self._recent: defaultdict[str, OrderedDict[tuple[int, int], None]] = defaultdict(OrderedDict)

    def look(self) -> None:
        """Subscribe to each kind of publisher as it publishes: reliable ones reliably, latched ones from the past."""
        if self._endings:
            there = [name for name, _ in self._node.get_topic_names_and_types() if name.endswith(self._endings)]
            self.topics = list(dict.fromkeys([*self.topics, *there]))
        for topic in self.topics:
            for found in self._node.get_publishers_info_by_topic(topic):
                self._hear(topic, found.topic_type, found.qos_profile, str(found.topic_type_hash))
            # Who publishes once and goes waits for the first subscription, which need not be ours: be there before.
            for found in self._node.get_subscriptions_info_by_topic(topic):
                if not any(key[:2] == (topic, found.topic_type) for key in self._heard):
                    self._hear(topic, found.topic_type, QoSProfile(depth=10), str(found.topic_type_hash))

    def _hear(self, topic: str, kind: str, offered: QoSProfile, type_hash: str) -> None:
        key = (topic, kind, offered.reliability, offered.durability)
        if key not in self._heard:
            self._heard[key] = self._subscribe(topic, kind, offered, type_hash)

    def _subscribe(self, topic: str, kind: str, offered: QoSProfile, type_hash: str) -> Subscription | None:
        log = self._node.get_logger()
        try:
            package, folder, name = kind.split("/")
            message = getattr(import_module(f"{package}.{folder}"), name)
        except (ValueError, ImportError, AttributeError):
            log.warning(f"{topic} is not heard: '{kind}' is not installed here")
            return None
        if kind not in TYPES.fielddefs:
            log.warning(f"{topic} is not heard: '{kind}' is no message of ROS 2 Jazzy")
            return None
        if type_hash not in (TYPES.hash_rihs01(kind), "INVALID"):  # other middlewares may have none
            log.warning(f"{topic} is not heard: '{kind}' is not that of ROS 2 Jazzy")
            return None
        # Publishers of other kinds on the topic are no fault: they have subscriptions of their own.
        self._found(topic, kind)
        return self._node.create_subscription(
            message,
            topic,
            partial(self._take, topic, kind),
            QoSProfile(depth=_DEPTH, reliability=offered.reliability, durability=offered.durability),
            event_callbacks=qos.SILENT_SUBSCRIPTION,
            raw=True,
        )

    def _take(self, topic: str, kind: str, data: bytes, info: dict[str, int]) -> None:
        if not self._seen(topic, info):
            self._pass_on(topic, kind, data, info["received_timestamp"] or time.time_ns())

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

    def drain(self) -> None:
        """Take what has arrived until now."""
        until = time.time_ns()
        for (topic, kind, *_), subscription in self._heard.items():
            if subscription is not None:
                self._drain(topic, kind, subscription, until)

    def _drain(self, topic: str, kind: str, subscription: Subscription, until: int) -> None:
        with subscription.handle:
            while taken := subscription.handle.take_message(subscription.msg_type, True):
                data, info = taken
                if info["received_timestamp"] > until:
                    return
                self._take(topic, kind, data, info)
