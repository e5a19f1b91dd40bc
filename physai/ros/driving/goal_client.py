"""Sending an arm from goal to goal over ROS 2, and seeing what it does."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from physai.deploy import Policy, State
from physai.errors import UserError
from physai.ros.driving.processes import NodeProcess
from physai.ros.node.guest import Guest
from physai.ros.topics import goals, joint_states, qos
from physai.ros.topics.commands import controller_topic
from physai.signals import Tolerance

_LOOK = 1.0  # s for others to be discovered
_START = 30.0  # s until both nodes work
_PER_GOAL = 60.0  # s
_SETTLE = 0.1  # s that a goal may take to the node


@dataclass
class GoalResult:
    """One goal.

    Attributes:
        goal: Its numbers, in the order of the policy's goal signal.
        unit: Of these numbers.
        tolerances: Errors that count as reached, one for each error of the policy.
        sent: When it was sent, s.
        reached: When it was reached, s; None if it never was.
        error: Largest errors while it was held.
    """

    goal: np.ndarray
    unit: str
    tolerances: tuple[Tolerance, ...]
    sent: float
    reached: float | None = None
    error: np.ndarray | None = None

    def within(self, error: np.ndarray | None) -> bool:
        """Whether errors are all within the tolerances."""
        limits = [tolerance.value for tolerance in self.tolerances]
        return error is not None and bool((error < limits).all())

    @property
    def kept(self) -> bool:
        """Whether it was reached, and the robot stayed within the tolerances."""
        return self.reached is not None and self.within(self.error)

    def describe(self) -> str:
        """One line."""
        where = f"({', '.join(f'{number:+.2f}' for number in self.goal)}) {self.unit}".rstrip()
        if self.reached is None or self.error is None:
            return f"{where}  not reached"
        worst = int(np.argmax(self.error / [tolerance.value for tolerance in self.tolerances]))
        return (
            f"{where}  reached in {self.reached - self.sent:4.1f} s, {'held' if self.kept else 'LEFT'}, "
            f"{self.tolerances[worst].name} at most {self.error[worst]:.3f} {self.tolerances[worst].unit}"
        )


@dataclass
class Record:
    """What happened.

    Attributes:
        results: Goals in order.
        times: Of the joint states, s.
        positions: Joint positions [n], rad.
    """

    results: list[GoalResult] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    positions: list[np.ndarray] = field(default_factory=list)


class GoalClient:
    """The node that sends goals and watches joint states and the inference node's state, in a context of its own.

    Args:
        policy: Tells how far the robot is from a goal.

    Attributes:
        record: What happened so far.
        watch: Processes that must not end meanwhile.
    """

    def __init__(self, policy: Policy) -> None:
        self.record = Record()
        self.watch: Sequence[NodeProcess] = ()
        self._policy = policy
        self._metadata = policy.metadata
        self._state = ""
        self._stopped = ""
        self._guest = Guest("goal_client")
        self._node = self._guest.node
        self._goals = self._node.create_publisher(goals.goal_type(policy.metadata.goal), "inference_node/goal", 1)
        self._node.create_subscription(JointState, joint_states.TOPIC, self._take_joint_state, qos.SENSOR)
        self._node.create_subscription(String, "inference_node/state", self._take_state, qos.LATCHED)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._take_diagnostics, 10)

    def check_alone(self) -> None:
        """See that there is no other robot whose controller would obey.

        Raises:
            UserError: If there is.
        """
        end = time.monotonic() + _LOOK
        while time.monotonic() < end:
            self._guest.executor.spin_once(0.05)
            topics = controller_topic(self._metadata.command.quantity), joint_states.TOPIC
            commands, states = map(self._node.resolve_topic_name, topics)
            for name, others in (
                (commands, self._node.count_subscribers(commands) + self._node.count_publishers(commands)),
                (states, self._node.count_publishers(states)),
            ):
                if others:
                    raise UserError(f"another node uses {name} here: choose another ROS_DOMAIN_ID")

    def wait_until_ready(self) -> None:
        """Wait for joint states, and for a node that waits for a goal.

        Raises:
            UserError: If they do not come.
        """
        ready = (State.WAITING.value, State.REACHED.value)
        if not self._spin(
            lambda: self.record.times and self._state in ready and self._goals.get_subscription_count(), _START
        ):
            raise UserError(f"the nodes do not work: joint states: {bool(self.record.times)}, state: '{self._state}'")

    def send(self, goal: np.ndarray, hold: float) -> GoalResult:
        """Send a goal [g], wait until it is reached, and watch the robot for a while, s.

        Raises:
            UserError: If the node stops the robot for good, or one of the processes has ended.
        """
        signal = self._metadata.goal
        result = GoalResult(goal, signal.unit, self._metadata.tolerances, time.monotonic())
        self.record.results.append(result)
        self._goals.publish(goals.to_message(goal.tolist(), signal, self._node.get_clock().now().to_msg()))
        self._spin(lambda: False, _SETTLE)
        if self._spin(lambda: self._state == State.REACHED.value and result.within(self._error(-1, goal)), _PER_GOAL):
            result.reached = time.monotonic()
            seen = len(self.record.positions)
            self._spin(lambda: False, hold)
            held = range(seen, len(self.record.positions))
            result.error = np.max([self._error(index, goal) for index in held], axis=0) if held else None
        return result

    def _error(self, index: int, goal: np.ndarray) -> np.ndarray:
        return self._policy.error(self.record.positions[index], goal)

    def _spin(self, done: Callable[[], object], seconds: float) -> bool:
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

    def _take_joint_state(self, message: JointState) -> None:
        index = [message.name.index(joint) for joint in self._metadata.joints]
        self.record.times.append(time.monotonic())
        self.record.positions.append(np.array(message.position)[index])

    def _take_state(self, message: String) -> None:
        self._state = message.data

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        self._stopped = next((s.message for s in message.status if s.level == DiagnosticStatus.ERROR), "")

    def close(self) -> None:
        """Leave ROS."""
        self._guest.close()
