"""Joint states as robots publish them: in one message or in parts, beside those of other joints, by one node or two."""

import time
from collections import defaultdict, deque
from collections.abc import Callable, Sequence

from rclpy.node import Node
from sensor_msgs.msg import JointState as JointStateMessage

from physai.deploy import JointState
from physai.ros.topics import qos
from physai.ros.topics.unawaited import Unawaited, waiting

TOPIC = "joint_states"  # in the robot's namespace
# Numbers of lost messages are skipped, at most so many and so many a second; farther on counts somebody else.
_LOST, _FASTEST = 64, 2000.0
_RIVALRY = 3.0  # s; two publishers are rivals for so long after they have taken turns


class JointStates:
    """Keeps the newest message of each part of the robot until it is taken.

    Args:
        node: Whose remaps and clock hold.
        joints: Those that matter; messages that name none of them are not looked at.
        heard: Called when messages have come that name some; None where it is enough to look with ``hear``.

    Attributes:
        stamp_age: Age of the last message by its stamp as it came, s; of use where the robot's clock agrees with ours.
        others: How many messages named none of the joints.
    """

    def __init__(self, node: Node, joints: Sequence[str], heard: Callable[[], None] | None) -> None:
        self._node, self._joints, self._heard = node, frozenset(joints), heard
        self.stamp_age: float | None = None
        self.others = 0
        self._newest: dict[tuple[str, ...], JointState] = {}
        self._publishers = Publishers()
        self._subscription = node.create_subscription(
            JointStateMessage,
            TOPIC,
            self._take,  # type: ignore[arg-type]  # rclpy also takes callbacks with two arguments
            qos.PARTS,
            callback_group=Unawaited() if heard is None else None,
        )

    def hear(self) -> bool:
        """Take what has come meanwhile, of which the newest of each part counts; return whether it names a joint."""
        ours = [self._keep(*taken) for taken in waiting(self._subscription)]
        return any(ours)

    def _take(self, message: JointStateMessage, info: dict[str, int]) -> None:
        ours = self._keep(message, info)
        # Whatever has come meanwhile, too: where messages have queued up, only the newest shall count.
        if (self.hear() or ours) and self._heard is not None:
            self._heard()

    def _keep(self, message: JointStateMessage, info: dict[str, int]) -> bool:
        names = tuple(message.name)
        ours = self._joints.intersection(names)
        if not ours:
            self.others += 1
            return False
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        received = qos.received_at(info)
        waited = time.monotonic() - received
        self.stamp_age = self._node.get_clock().now().nanoseconds * 1e-9 - waited - stamp
        source = self._publishers.source(ours, info["publication_sequence_number"], time.monotonic())
        self._newest.pop(names, None)  # the order is that in which they came
        self._newest[names] = JointState(
            names, message.position, message.velocity, stamp, received, message.effort, source
        )
        return True

    def take(self) -> list[JointState]:
        """Return what was heard since the last time."""
        states, self._newest = list(self._newest.values()), {}
        return states

    def rivals(self, now: float) -> str | None:
        """Who claims the same joint, if two do; None if nobody does."""
        joint = self._publishers.contested(now)
        if joint is None:
            return None
        topic = self._subscription.topic_name
        names = sorted(info.node_name for info in self._node.get_publishers_info_by_topic(topic))
        return f"two publishers of {topic} claim '{joint}': {', '.join(names)}"


class Publishers:
    """Tells publishers apart, of whom rclpy does not say which one a message is from: each counts its messages."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, float]] = {}
        self._source: dict[str, int] = {}
        self._sources = 0
        self._turns: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=2))

    def source(self, joints: frozenset[str], number: int | None, now: float) -> int | None:
        """Return a name for the publisher of these joints' message; None where messages are not counted.

        Args:
            joints: Whose state it tells.
            number: Of the message, by its publisher's count; it grows as long as the publisher is the same.
            now: The time, s.
        """
        if not number:
            return None
        before = {self._source.get(joint) for joint in joints}
        last = {joint: self._last.get(joint, (0, now)) for joint in joints}
        turned = [joint for joint, (count, _) in last.items() if number <= count]
        ahead = any(count and number - count > _LOST + _FASTEST * (now - at) for count, at in last.values())
        for joint in turned:
            self._turns[joint].append(now)
        if turned or ahead or len(before) > 1 or None in before:
            self._sources += 1
            self._source.update(dict.fromkeys(joints, self._sources))
        self._last.update(dict.fromkeys(joints, (number, now)))
        return self._source[next(iter(joints))]

    def contested(self, now: float) -> str | None:
        """A joint whose publishers have taken turns of late: one was there, another came, and the first spoke again."""
        for joint, turns in self._turns.items():
            if len(turns) == 2 and now - turns[0] < _RIVALRY:
                return joint
        return None
