"""Who else publishes a topic on which one publisher is allowed: strangers, and those who may."""

from collections import defaultdict

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

_PARTICIPANT = 12  # bytes of a DDS endpoint's id that are its process' own
_UNKNOWN = "_NODE_NAME_UNKNOWN_"  # of an endpoint that is heard of before its node


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

    def others(self) -> list[str]:
        """Names of the nodes that publish the topic and may not."""
        if self._node.count_publishers(self._topic) <= 1:
            return []
        found = self._node.get_publishers_info_by_topic(self._topic)
        if self._partners:
            found = self._strangers(found)
        if len(found) <= 1:
            return []
        own = self._node.get_fully_qualified_name()
        names = [_name(info) for info in found]
        return sorted(name.lstrip("/") for name in names if name != own) or ["a node of the same name"]

    def _strangers(self, found: list[TopicEndpointInfo]) -> list[TopicEndpointInfo]:
        """Leave partners out; who was one remains one until it has gone: of its two topics one goes first."""
        present = {_process(info) for info in found}
        known = defaultdict(set, {process: names for process, names in self._known.items() if process in present})
        for info in self._node.get_publishers_info_by_topic(self._partners):
            known[_process(info)].add(_name(info))
        self._known = dict(known)
        return [info for info in found if not self._is_partner(info)]

    def _is_partner(self, info: TopicEndpointInfo) -> bool:
        names = self._known.get(_process(info), set())
        return bool(names) and (_name(info) in names or _UNKNOWN in _name(info) or any(_UNKNOWN in n for n in names))


def _process(info: TopicEndpointInfo) -> bytes:
    return bytes(info.endpoint_gid[:_PARTICIPANT])


def _name(info: TopicEndpointInfo) -> str:
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"
