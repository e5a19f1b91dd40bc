"""Who else publishes a topic on which one publisher is allowed: strangers, and those who may."""

import math
import time
from collections import defaultdict
from typing import NamedTuple

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

_PARTICIPANT = 12  # bytes of a DDS endpoint's id that are its process' own
_LOOK = 0.05  # s between two looks at who they are, while there are as many: each costs as much as to pass on a command
_UNKNOWN = "_NODE_NAME_UNKNOWN_"  # of an endpoint that is heard of before its node


class _Publisher(NamedTuple):
    process: bytes
    name: str


class Companions:
    """Looks for other publishers of a topic.

    Args:
        node: Publishes it once.
        topic: Which one, as ROS resolves it.
        partners: Who publishes this other topic may publish ours, too; empty if nobody may.
    """

    def __init__(self, node: Node, topic: str, partners: str) -> None:
        self._node = node
        self._topic = topic
        self._partners = node.resolve_topic_name(partners) if partners else ""
        self._known: dict[bytes, set[str]] = {}  # names of nodes, by the id of their process
        self._allowed: list[_Publisher] = []  # those of our topic when nobody was a stranger, for the last time
        self._looked = -math.inf

    def others(self) -> list[str]:
        """Names of the nodes that publish the topic and may not."""
        with self._node.handle:
            count = self._node.handle.get_count_publishers(self._topic)
        now = time.monotonic()
        if count <= 1:
            self._allowed = []
            return []
        if count == len(self._allowed) and now - self._looked < _LOOK:
            return []
        self._looked = now
        found = self._publishers(self._topic)
        if self._partners:
            strangers = self._strangers(found)
            self._allowed = found if len(strangers) <= 1 else []
            found = strangers
        if len(found) <= 1:
            return []
        own = self._node.get_fully_qualified_name()
        names = [each.name for each in found]
        return sorted(name.lstrip("/") for name in names if name != own) or ["a node of the same name"]

    def _publishers(self, topic: str) -> list[_Publisher]:
        """As ``Node.get_publishers_info_by_topic`` has them, without what it makes of their qualities of service.

        That costs more than all else in a watchdog, which looks at each command.
        """
        with self._node.handle:
            found = rclpy_implementation.rclpy_get_publishers_info_by_topic(self._node.handle, topic, False)
        return [
            _Publisher(
                bytes(each["endpoint_gid"][:_PARTICIPANT]), f"{each['node_namespace'].rstrip('/')}/{each['node_name']}"
            )
            for each in found
        ]

    def _strangers(self, found: list[_Publisher]) -> list[_Publisher]:
        """Leave partners out; who was one remains one until it has gone: of its two topics one goes first."""
        present = {each.process for each in found}
        known = defaultdict(set, {process: names for process, names in self._known.items() if process in present})
        for each in self._publishers(self._partners):
            known[each.process].add(each.name)
        self._known = dict(known)
        return [each for each in found if not self._is_partner(each)]

    def _is_partner(self, publisher: _Publisher) -> bool:
        names = self._known.get(publisher.process, set())
        name = publisher.name
        return bool(names) and (name in names or _UNKNOWN in name or any(_UNKNOWN in known for known in names))
