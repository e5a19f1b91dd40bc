"""The topic /emergency_stop: heard from every publisher, and still pressed while a latched one says so."""

import time
from collections import Counter
from collections.abc import Callable

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import Bool

from physai.ros.topics import qos

TOPIC = "/emergency_stop"
_AGAIN = 0.5  # s until all latched publishers have surely told again what they said last


class EmergencyStopTopic:
    """Listens to /emergency_stop.

    Args:
        node: Whose subscriptions they are.
        stop: Called at each true.
    """

    def __init__(self, node: Node, stop: Callable[[], None]) -> None:
        self._node = node
        self._stop = stop
        for profile in qos.EMERGENCY:
            node.create_subscription(Bool, TOPIC, self._take, profile, event_callbacks=qos.SILENT_SUBSCRIPTION)
        # What latched publishers said last. A message does not tell whose it is, but has a number: it follows the one
        # with the number before, a false if there are several. A false takes the place of a true only where each
        # publisher has had its say: else the true may be another's. Too many are forgotten when all are asked again.
        self._last: Counter[tuple[int, bool]] = Counter()
        self._latched = self._subscribe()
        self._asked = -_AGAIN

    def _subscribe(self) -> Subscription:
        return self._node.create_subscription(
            Bool,
            TOPIC,
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
            for info in self._node.get_publishers_info_by_topic(TOPIC)
            if info.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL
            and info.qos_profile.reliability is ReliabilityPolicy.RELIABLE
        ]

    def held(self) -> str | None:
        """Why a reset would be wrong now, or None: who latches a true still does."""
        if time.monotonic() - self._asked < _AGAIN:
            return f"looking whether {TOPIC} is still true: call again"
        latching = self._latching()
        if not latching or not any(pressed for _, pressed in self._last):
            return None
        # Who said it may be one that has left: ask those who are there.
        self._node.destroy_subscription(self._latched)
        self._last.clear()
        self._latched = self._subscribe()
        self._asked = time.monotonic()
        return f"{TOPIC} is still true, latched: {', '.join(sorted(latching))}"
