"""Topics that stop robots: heard from every publisher, and still pressed while a latched one says so."""

import time
from collections import Counter
from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import Bool

from physai.ros.topics import qos

ALL = "/emergency_stop"
"""Stops every robot, whatever its namespace."""

TOPICS = (ALL, "emergency_stop")
"""What a robot listens to: also to one of its own, in its namespace; outside of one, both are the same."""

_AGAIN = 0.5  # s until all latched publishers have surely told again what they said last


class EmergencyStopTopic:
    """Listens to one of them.

    Args:
        node: Whose subscriptions they are.
        stop: Called at each true.
        topic: Which one.
    """

    def __init__(self, node: Node, stop: Callable[[], None], topic: str = ALL) -> None:
        self._node = node
        self._topic = topic
        self._stop = stop
        for profile in qos.EMERGENCY:
            node.create_subscription(Bool, topic, self._take, profile, event_callbacks=qos.SILENT_SUBSCRIPTION)
        # What latched publishers said last. A message does not tell whose it is, but has a number: it follows the one
        # with the number before, a false if there are several. A false takes the place of a true only where each
        # publisher has had its say: else the true may be another's. Too many are forgotten when all are asked again.
        self._last: Counter[tuple[int, bool]] = Counter()
        self._latched = self._subscribe()
        self._asked = -_AGAIN

    def _subscribe(self) -> Subscription:
        return self._node.create_subscription(
            Bool,
            self._topic,
            self._take_latched,  # type: ignore[arg-type]  # rclpy also takes callbacks with two arguments
            qos.EMERGENCY_LATCHED,
            event_callbacks=qos.SILENT_SUBSCRIPTION,
        )

    def _take(self, message: Bool) -> None:
        if message.data:
            self._stop()

    def _take_latched(self, message: Bool, info: dict[str, int]) -> None:
        self._take(message)
        number = info["publication_sequence_number"] or 0  # None from middlewares that do not count
        if self._last[number - 1, False]:
            self._last[number - 1, False] -= 1
        elif self._last[number - 1, True] and (message.data or self._last.total() >= len(self._latching())):
            self._last[number - 1, True] -= 1
        self._last[number, message.data] += 1
        self._last = +self._last

    def _latching(self) -> list[str]:
        return [
            info.node_name
            for info in self._node.get_publishers_info_by_topic(self._topic)
            if info.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL
            and info.qos_profile.reliability is ReliabilityPolicy.RELIABLE
        ]

    def held(self) -> str | None:
        """Why a reset would be wrong now, or None: who latches a true still does."""
        if time.monotonic() - self._asked < _AGAIN:
            return f"looking whether {self._latched.topic_name} is still true: call again"
        latching = self._latching()
        if not latching or not any(pressed for _, pressed in self._last):
            return None
        # Who said it may be one that has left: ask those who are there.
        self._node.destroy_subscription(self._latched)
        self._last.clear()
        self._latched = self._subscribe()
        self._asked = time.monotonic()
        return f"{self._latched.topic_name} is still true, latched: {', '.join(sorted(latching))}"


class EmergencyStopTopics:
    """Listens to all that stop a robot.

    Args:
        node: The robot's; its namespace counts.
        stop: Called at each true, with the name of the topic.
    """

    def __init__(self, node: Node, stop: Callable[[str], None]) -> None:
        names = dict.fromkeys(map(node.resolve_topic_name, TOPICS))
        self._topics = [EmergencyStopTopic(node, partial(stop, name), name) for name in names]

    def held(self) -> str | None:
        """Why a reset would be wrong now, or None; each is asked, so that none has to wait for the others."""
        return "; ".join(filter(None, [topic.held() for topic in self._topics])) or None
