"""Sending the arms of a fleet from goal to goal over ROS 2, and seeing what each of them does."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.publisher import Publisher
from std_msgs.msg import String

from physai.deploy import Metadata, State
from physai.errors import UserError
from physai.ros.driving.forked import ForkedProcess
from physai.ros.node.guest import Guest
from physai.ros.topics import goals, joint_states, qos
from physai.seeding import derive

_START = 120.0  # s until all nodes work


@dataclass
class Arm:
    """One arm, as it tells of itself.

    Attributes:
        metadata: Of its policy.
        goals: Where its goals go.
        random: Draws them.
        state: Of its inference node.
        why: Its state with reasons, in words.
        since: When it came into this state, s.
        sent: How many goals it got.
        reached: How many of them it reached.
    """

    metadata: Metadata
    goals: Publisher
    random: torch.Generator
    state: str = ""
    why: str = ""
    since: float = field(default_factory=time.monotonic)
    sent: int = 0
    reached: int = 0

    @property
    def rests(self) -> bool:
        """Whether it waits for a goal; a hold that lasts does, too: one that is late goes on by itself at once."""
        return self.state in (State.WAITING.value, State.REACHED.value, State.HOLD.value)


class FleetClient:
    """A node in a context of its own that sends goals to the inference nodes of namespaces, and watches them.

    Args:
        fleet: Metadata of the policy in each namespace.
        seed: Of the goals.
        tell: Called with a namespace and its arm at each change of an arm's state.

    Attributes:
        arms: By namespace.
    """

    def __init__(self, fleet: Mapping[str, Metadata], seed: int, tell: Callable[[str, Arm], None]) -> None:
        self._tell = tell
        self._guest = Guest("fleet")
        self._node = node = self._guest.node
        self.arms: dict[str, Arm] = {}
        for namespace, metadata in fleet.items():
            name = f"{namespace}/inference_node"
            publisher = node.create_publisher(goals.goal_type(metadata.goal), f"{name}/goal", 1)
            random = torch.Generator().manual_seed(derive(seed, f"goals of {namespace}"))
            self.arms[namespace] = Arm(metadata, publisher, random)
            node.create_subscription(String, f"{name}/state", partial(self._take_state, namespace), qos.LATCHED)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._take_diagnostics, 100)

    def wait_until_ready(self, nodes: list[ForkedProcess]) -> None:
        """Wait until each inference node waits for a goal.

        Raises:
            UserError: If they do not, one of the nodes has ended, or a namespace has another robot.
        """

        def ready() -> bool:
            check(nodes)
            self._check_alone()
            arms = self.arms.values()
            return all(arm.state == State.WAITING.value and arm.goals.get_subscription_count() for arm in arms)

        if not self._spin(ready, _START):
            told = ", ".join(f"{name}: {arm.why or arm.state or 'silent'}" for name, arm in self.arms.items())
            raise UserError(f"not all nodes work after {_START:g} s: {told}")

    def drive(self, nodes: list[ForkedProcess], hold: float, seconds: float) -> None:
        """Send each arm a goal, and another one a while after it has reached it or given up, s.

        Raises:
            UserError: If one of the nodes has ended, or a namespace has another robot.
        """

        def work() -> bool:
            check(nodes)
            self._check_alone()  # who was there before may be found late
            now = time.monotonic()
            for arm in self.arms.values():
                if arm.rests and now - arm.since > hold:
                    self._send(arm)
            return False

        self._spin(work, seconds)

    def _check_alone(self) -> None:
        for namespace in self.arms:
            topic = f"{namespace}/{joint_states.TOPIC}"
            if self._node.count_publishers(topic) > 1:
                raise UserError(f"another robot tells of itself on {topic}: choose another ROS_DOMAIN_ID")

    def _send(self, arm: Arm) -> None:
        goal = arm.metadata.region.sample(1, arm.random)[0].tolist()
        arm.goals.publish(goals.to_message(goal, arm.metadata.goal, self._node.get_clock().now().to_msg()))
        arm.sent += 1
        arm.since = time.monotonic()

    def _spin(self, done: Callable[[], bool], seconds: float) -> bool:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._guest.executor.spin_once(0.05)
            if done():
                return True
        return False

    def _take_state(self, namespace: str, message: String) -> None:
        arm = self.arms[namespace]
        arm.reached += message.data == State.REACHED.value and arm.sent > arm.reached
        arm.state, arm.since = message.data, time.monotonic()

    def _take_diagnostics(self, message: Any) -> None:
        for status in message.status:
            namespace = f"/{status.name.partition('/')[0]}"
            arm = self.arms.get(namespace)
            if arm is not None and arm.why != status.message:
                arm.why = status.message
                self._tell(namespace, arm)

    def close(self) -> None:
        """Leave ROS."""
        self._guest.close()


def check(nodes: list[ForkedProcess]) -> None:
    """See that all nodes run.

    Raises:
        UserError: If one has ended.
    """
    for node in nodes:
        if node.ended:
            raise UserError(f"the process of the {node.name} has ended: {node.last_words()}")
