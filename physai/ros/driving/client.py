"""What is common to those who have a robot driven over ROS 2: they see that it is alone, alive and not stopped."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from std_msgs.msg import String

from physai.deploy import Metadata
from physai.errors import UserError
from physai.ros.driving.processes import NodeProcess
from physai.ros.node.guest import Guest
from physai.ros.topics import goals, joint_states, qos
from physai.ros.topics.commands import controller_topic

_LOOK = 1.0  # s for others to be discovered
_START = 30.0  # s until all nodes work


class Client(ABC):
    """A node that sends goals and watches the inference node's state, in a context of its own.

    Args:
        metadata: Of the policy that drives.
        name: Of the node.

    Attributes:
        watch: Processes that must not end meanwhile.
        state: What the inference node said last.
    """

    def __init__(self, metadata: Metadata, name: str) -> None:
        self.watch: Sequence[NodeProcess] = ()
        self.state = ""
        self._metadata = metadata
        self._stopped = ""
        self._guest = Guest(name)
        self.node = self._guest.node
        goal = metadata.goal
        topic = goals.topic(goal).replace("~", "inference_node")
        self._goals = self.node.create_publisher(goals.goal_type(goal), topic, 1)
        self.node.create_subscription(String, "inference_node/state", self._take_state, qos.LATCHED)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._take_diagnostics, 10)

    def check_alone(self) -> None:
        """See that there is no other robot whose controller would obey.

        Raises:
            UserError: If there is.
        """
        end = time.monotonic() + _LOOK
        while time.monotonic() < end:
            self._guest.executor.spin_once(0.05)
            topics = controller_topic(self._metadata.command.quantity), joint_states.TOPIC
            commands, states = map(self.node.resolve_topic_name, topics)
            for name, others in (
                (commands, self.node.count_subscribers(commands) + self.node.count_publishers(commands)),
                (states, self.node.count_publishers(states)),
            ):
                if others:
                    raise UserError(f"another node uses {name} here: choose another ROS_DOMAIN_ID")

    def wait_until(self, what: str, there: Callable[[], object], states: Sequence[str]) -> None:
        """Wait until the robot is heard of, and the inference node is in one of some states.

        Args:
            what: What tells that the robot is heard of, for the error.
            there: Whether it is.
            states: Of the inference node.

        Raises:
            UserError: If that takes too long.
        """
        if not self.spin(lambda: there() and self.state in states and self._goals.get_subscription_count(), _START):
            raise UserError(f"the nodes do not work: {what}: {bool(there())}, state: '{self.state}'")

    @abstractmethod
    def wait_until_ready(self) -> None:
        """Wait until the robot is heard of and waits for a goal; raises a UserError if that takes too long."""

    @abstractmethod
    def drive(self, goals: int, hold: float, seed: int) -> Iterator[tuple[str, bool]]:
        """Send goals one after the other; yield what became of each, in a line, and whether it is what was wanted.

        Args:
            goals: How many.
            hold: For how long the robot stays where it is sent, s.
            seed: Draws them, where they are drawn.

        Raises:
            UserError: If the node stops the robot for good, or one of the processes has ended.
        """

    @abstractmethod
    def done(self, hold: float) -> str:
        """What was wanted, in words."""

    @abstractmethod
    def draw(self, output: Path) -> None:
        """Draw the path into a PNG."""

    def publish(self, goal: Sequence[float]) -> None:
        """Send a goal."""
        self._goals.publish(goals.to_message(goal, self._metadata.goal, self.node.get_clock().now().to_msg()))

    def spin(self, done: Callable[[], object], seconds: float) -> bool:
        """Let messages come until something is done, for at most so many seconds; return whether it is done.

        Raises:
            UserError: If the node stops the robot for good, or one of the processes has ended.
        """
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._guest.executor.spin_once(0.05)
            if done():
                return True
            if self._stopped:
                raise UserError(f"the inference node has stopped the robot: {self._stopped}")
            for process in self.watch:
                if process.ended:
                    raise UserError(f"{process.module} has ended: {process.last_words()}")
        return False

    def _take_state(self, message: String) -> None:
        self.state = message.data

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        self._stopped = next((s.message for s in message.status if s.level == DiagnosticStatus.ERROR), "")

    def close(self) -> None:
        """Leave ROS."""
        self._guest.close()
