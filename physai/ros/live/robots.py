"""The robots of a domain: each is found by its inference node, listened to, and asked for what people want of it."""

import math
import queue
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Bool, String
from std_srvs.srv import SetBool, Trigger

from physai.deploy import PolicyError, State
from physai.deploy.metadata import read_goal
from physai.errors import UserError
from physai.ros.live.status import Status
from physai.ros.topics import goals, imu, joint_states, qos
from physai.ros.topics.emergency_stop import ALL
from physai.ros.topics.unawaited import Unawaited, nobody, waiting
from physai.signals import Quantity

_NODE = "inference_node"
_HEAR = 0.02  # s between two looks for what sensors have told
_MOST = 64  # robots
_FORGET = 300.0  # s after which a robot that has gone is not shown any more
_STALE = 0.5  # s that what people ask may wait: what comes later, nobody expects any more
_ANSWER = 5.0  # s
_HEARD = 0.1  # s after which a robot that has heard a stop of all says that it stands
_SERVICES = {"enable": SetBool, "reset": Trigger, "estop": Trigger}


@dataclass(frozen=True)
class Ask:
    """What somebody wants.

    Attributes:
        what: Of which kind it is.
        namespace: Of which robot; of no meaning for a stop of all.
        goal: Its numbers, in the order of the robot's goal signal.
        at: When, s.
    """

    what: Literal["stop all", "stop", "enable", "reset", "goal"]
    namespace: str = ""
    goal: np.ndarray | None = None
    at: float = field(default_factory=time.monotonic)

    @property
    def stops(self) -> bool:
        """Whether it can only stop: then it is never too late."""
        return self.what in ("stop all", "stop")


class Robots:
    """Listens to all robots, and does what is asked of them; none of it waits for anybody.

    It latches nothing: when it goes, no robot hears of it, and whatever it stopped remains so until somebody resets it.

    Args:
        node: Whose subscriptions they are.
        commands: Whether it can ask anything at all; else it has no publisher and no client.

    Attributes:
        stopped: When all were stopped by this object, s; None if they were not.
    """

    def __init__(self, node: Node, commands: bool) -> None:
        self._node = node
        self._commands = commands
        self._links: dict[str, _Link] = {}
        self._asked: queue.SimpleQueue[Ask] = queue.SimpleQueue()
        self._wake = node.create_guard_condition(self._work)
        self._everyone = _button(node, ALL) if commands else None
        self._looked = time.monotonic()
        self._insists = math.inf  # when those are asked that have not stopped
        self.stopped: float | None = None
        node.create_subscription(DiagnosticArray, "/diagnostics", self._take_diagnostics, 100)
        node.create_timer(_HEAR, self._hear, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def all(self) -> list[Status]:
        """What is known of each; from any thread."""
        return [link.status for _, link in sorted(self._links.copy().items())]

    def ask(self, wanted: Ask) -> None:
        """Have something done soon; from any thread, and without waiting."""
        self._asked.put(wanted)
        self._wake.trigger()

    def look(self) -> None:
        """See who has come and who has gone; to be called now and then."""
        now = time.monotonic()
        elapsed, self._looked = now - self._looked, now
        for topic, kinds in self._node.get_topic_names_and_types():
            namespace = topic.removesuffix(f"/{_NODE}/state")
            new = namespace != topic and namespace not in self._links and len(self._links) < _MOST
            if new and "std_msgs/msg/String" in kinds and self._node.count_publishers(topic):
                self._links[namespace] = _Link(self._node, namespace, self._commands)
        for namespace, link in list(self._links.items()):
            link.look(now, elapsed)
            if not link.status.present and now - link.status.since > _FORGET:
                self._links.pop(namespace).close()

    def _hear(self) -> None:
        for link in self._links.values():
            link.hear()
        if time.monotonic() >= self._insists:
            self._insists = math.inf
            for link in self._links.values():
                link.insist()

    def _take_diagnostics(self, message: Any) -> None:
        for status in message.status:
            name = f"/{status.name.partition(': ')[0]}"
            link = self._links.get(name.removesuffix(f"/{_NODE}"))
            if link is not None and name.endswith(f"/{_NODE}"):
                link.status.values = {pair.key: pair.value for pair in status.values}
                link.status.words, link.status.told = status.message, time.monotonic()

    def _work(self) -> None:
        while not self._asked.empty():
            wanted = self._asked.get()
            if wanted.what == "stop all" and self._everyone is not None:
                self._everyone.publish(Bool(data=True))
                self.stopped = time.monotonic()
                self._insists = self.stopped + _HEARD
                self._node.get_logger().warning("stop all: asked for on the page")
            elif (link := self._links.get(wanted.namespace)) is not None:
                if not wanted.stops and time.monotonic() - wanted.at > _STALE:
                    link.say(f"{wanted.what}: not sent, as it came too late")
                else:
                    link.do(wanted)


class _Link:
    """One robot: what is heard of it, and how it is asked."""

    def __init__(self, node: Node, namespace: str, commands: bool) -> None:
        self.status = Status(namespace)
        self._node, self._commands = node, commands
        self._name = f"{namespace}/{_NODE}"
        self._count = 0
        self._joints: Any = None
        self._imu: Any = None
        self._goal: Any = None
        self._walks = False
        self._goals: Publisher | None = None
        self._waiting: list[tuple[float, Any, Any]] = []  # since when, client, future
        topics: dict[str, Callable[[Any], None]] = {
            "state": self._take_state,
            "robot_description": self._take_description,
            "goal_description": self._take_goal_description,
        }
        self._made = [
            node.create_subscription(String, f"{self._name}/{topic}", take, qos.LATCHED)
            for topic, take in topics.items()
        ]
        self._clients: dict[str, Any] = {}
        self._stop: Publisher | None = None
        if commands:
            for name, kind in _SERVICES.items():
                self._clients[name] = node.create_client(kind, f"{self._name}/{name}")
            if namespace:  # without one it would be everyone's
                self._stop = _button(node, f"{namespace}/emergency_stop")

    def look(self, now: float, elapsed: float) -> None:
        """See whether it is there, and how often its joint states come."""
        status = self.status
        present = self._node.count_publishers(f"{self._name}/state") > 0
        if present != status.present:
            status.present, status.since = present, now
            if not present:  # another one may come, with other joint states
                self._destroy_sensors()
        status.rate = self._count / elapsed if elapsed > 0 else 0.0
        self._count = 0
        if present and self._joints is None and (topic := self._heard("JointState", joint_states.TOPIC)):
            self._joints = self._unawaited(JointState, topic)
        if present and self._walks and self._imu is None and (topic := self._heard("Imu", imu.TOPIC)):
            self._imu = self._unawaited(Imu, topic)
        for since, client, future in self._waiting[:]:
            if now - since > _ANSWER and not future.done():
                client.remove_pending_request(future)
                self.say("no answer: ask again, or look there")
            if now - since > _ANSWER or future.done():
                self._waiting.remove((since, client, future))

    def _unawaited(self, kind: type, topic: str) -> Subscription:
        """Sensors speak so often that to be woken by each of them would be most of a page's work."""
        return self._node.create_subscription(kind, topic, nobody, qos.PARTS, callback_group=Unawaited())

    def hear(self) -> None:
        """Take what its sensors have told meanwhile."""
        if self._joints is not None:
            for message, info in waiting(self._joints):
                self._take_joints(message, qos.received_at(info))
        if self._imu is not None:
            for message, _ in waiting(self._imu):
                self._take_imu(message)

    def _heard(self, kind: str, name: str) -> str | None:
        """Where it hears a kind of sensor_msgs, which may have been remapped; None while that is not known."""
        try:
            heard = self._node.get_subscriber_names_and_types_by_node(_NODE, self.status.namespace or "/")
        except NodeNameNonExistentError:
            return None
        topics = [topic for topic, kinds in heard if f"sensor_msgs/msg/{kind}" in kinds]
        others = [topic for topic in topics if topic != f"{self._name}/goal"]
        own = f"{self.status.namespace}/{name}"
        return own if own in others else next(iter(others), None)

    def _take_state(self, message: String) -> None:
        self.status.state = message.data

    def _take_description(self, message: String) -> None:
        self.status.description = message.data

    def _take_goal_description(self, message: String) -> None:
        self.status.goal_description = message.data
        try:
            self._goal, _, _ = read_goal(message.data)
            kind, self._walks = goals.goal_type(self._goal), self._goal.quantity is Quantity.TWIST
            if self._walks:
                raise UserError("it follows velocities, which this page does not send")
        except (PolicyError, UserError) as error:
            self._goal = None
            self.say(str(error))
            return
        if self._commands:
            if self._goals is not None:
                self._node.destroy_publisher(self._goals)
            self._goals = self._node.create_publisher(kind, f"{self._name}/goal", 1)

    def _take_joints(self, message: JointState, received: float) -> None:
        self._count += 1
        if len(message.name) == len(message.position):
            told = dict(zip(message.name, message.position, strict=True))
            self.status.joint_position = {**self.status.joint_position, **told}
            self.status.moved = received

    def _take_imu(self, message: Imu) -> None:
        turn = message.orientation
        known = message.orientation_covariance[0] != -1  # sensor_msgs/Imu: else it has none
        self.status.turn = np.array([turn.x, turn.y, turn.z, turn.w]) if known else None

    def say(self, words: str) -> None:
        """Tell what became of what was asked."""
        self.status.said, self.status.said_at = words, time.monotonic()

    def do(self, wanted: Ask) -> None:
        """Ask it."""
        if wanted.what == "goal":
            self._send(wanted.goal)
        elif wanted.what == "stop" and self._stop is not None:
            self._stop.publish(Bool(data=True))
            self.say("stop: sent")
        elif wanted.what in ("stop", "reset"):
            self._call("estop" if wanted.what == "stop" else "reset", Trigger.Request())
        elif wanted.what == "enable":
            self._call("enable", SetBool.Request(data=True))

    def insist(self) -> None:
        """Stop it by its service, if it has not stopped: it may listen to a topic of another name."""
        if self.status.present and self.status.state != State.ESTOP.value:
            self._call("estop", Trigger.Request())

    def _send(self, goal: np.ndarray | None) -> None:
        if self._goals is None or self._goal is None or goal is None or goal.shape != self._goal.shape:
            self.say("goal: not sent, as the robot has not said what its goals are")
        elif not self._goals.get_subscription_count():
            self.say("goal: not sent, as nobody listens")
        else:
            stamp = self._node.get_clock().now().to_msg()
            self._goals.publish(goals.to_message(goal.tolist(), self._goal, stamp))
            self.status.goal_sent = goal, time.monotonic()
            self.say(f"goal: sent {', '.join(f'{number:.3f}' for number in goal)}")

    def _call(self, service: str, request: Any) -> None:
        client = self._clients.get(service)
        if client is None or not client.service_is_ready():
            self.say(f"{service}: not asked, as the service is not there")
            return
        future = client.call_async(request)
        future.add_done_callback(partial(self._take_answer, service))
        self._waiting.append((time.monotonic(), client, future))
        self.say(f"{service}: asked")

    def _take_answer(self, service: str, future: Any) -> None:
        if (answer := future.result()) is not None:
            self.say(f"{service}: {'' if answer.success else 'REFUSED: '}{answer.message}")

    def _destroy_sensors(self) -> None:
        for subscription in (self._joints, self._imu):
            if subscription is not None:
                self._node.destroy_subscription(subscription)
        self._joints = self._imu = None
        self.status.joint_position, self.status.moved, self.status.turn = {}, -math.inf, None

    def close(self) -> None:
        """Listen no more."""
        self._destroy_sensors()
        for subscription in self._made:
            self._node.destroy_subscription(subscription)
        for client in self._clients.values():
            self._node.destroy_client(client)
        for publisher in (self._goals, self._stop):
            if publisher is not None:
                self._node.destroy_publisher(publisher)


def _button(node: Node, topic: str) -> Publisher:
    """An emergency stop that latches nothing: one that did would free the robots by going."""
    return node.create_publisher(Bool, topic, 10, event_callbacks=qos.SILENT_PUBLISHER)
