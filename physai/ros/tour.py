"""Sending an arm from goal to goal over ROS 2, and seeing what it does."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from physai.deploy import Policy, State
from physai.errors import UserError
from physai.ros import qos
from physai.ros.commands import TOPIC
from physai.ros.processes import NodeProcess
from physai.ros.run import prepare_middleware

_LOOK = 1.0  # s for others to be discovered
_START = 30.0  # s until both nodes work
_PER_GOAL = 60.0  # s
_SETTLE = 0.1  # s that a goal may take to the node


@dataclass
class Visit:
    """One goal.

    Attributes:
        goal: x and y, m.
        tolerance: Distance that counts as reached, m.
        sent: When it was sent, s.
        reached: When it was reached, s; None if it never was.
        farthest: Largest distance of the tip from the goal while it was held, m.
    """

    goal: np.ndarray
    tolerance: float
    sent: float
    reached: float | None = None
    farthest: float = np.inf

    @property
    def kept(self) -> bool:
        """Whether it was reached, and the tip stayed within the tolerance."""
        return self.reached is not None and self.farthest < self.tolerance

    def describe(self) -> str:
        """One line."""
        where = f"({self.goal[0]:+.2f}, {self.goal[1]:+.2f}) m"
        if self.reached is None:
            return f"{where}  not reached"
        return (
            f"{where}  reached in {self.reached - self.sent:4.1f} s, "
            f"{'held' if self.kept else 'LEFT'}, at most {self.farthest * 100:.1f} cm away"
        )


@dataclass
class Tour:
    """What happened.

    Attributes:
        visits: Goals in order.
        times: Of the joint states, s.
        positions: Joint positions [n], rad.
    """

    visits: list[Visit] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    positions: list[np.ndarray] = field(default_factory=list)


class Tourist:
    """The node that sends goals and watches joint states and the inference node's state, in a context of its own.

    Args:
        policy: Tells how far the tip is from a goal.

    Attributes:
        tour: What happened so far.
        watch: Processes that must not end meanwhile.
    """

    def __init__(self, policy: Policy) -> None:
        self.tour = Tour()
        self.watch: Sequence[NodeProcess] = ()
        self._policy = policy
        self._metadata = policy.metadata
        self._state = ""
        prepare_middleware()
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("tourist", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._goals = self._node.create_publisher(PointStamped, "/inference_node/goal", 1)
        self._node.create_subscription(JointState, "/joint_states", self._take_joint_state, qos.SENSOR)
        self._node.create_subscription(String, "/inference_node/state", self._take_state, qos.LATCHED)

    def check_alone(self) -> None:
        """See that there is no other robot whose controller would obey.

        Raises:
            UserError: If there is.
        """
        end = time.monotonic() + _LOOK
        while time.monotonic() < end:
            self._executor.spin_once(0.05)
            for topic, others in (
                (TOPIC, self._node.count_subscribers(TOPIC) + self._node.count_publishers(TOPIC)),
                ("/joint_states", self._node.count_publishers("/joint_states")),
            ):
                if others:
                    raise UserError(f"another node uses {topic} here: choose another ROS_DOMAIN_ID")

    def wait_until_ready(self) -> None:
        """Wait for joint states, and for a node that waits for a goal.

        Raises:
            UserError: If they do not come.
        """
        ready = (State.WAITING.value, State.REACHED.value)
        self._spin(
            lambda: bool(self.tour.times) and self._state in ready and self._goals.get_subscription_count(), _START
        )
        if not self.tour.times or self._state not in ready:
            raise UserError(f"the nodes do not work: joint states: {bool(self.tour.times)}, state: '{self._state}'")

    def visit(self, goal: np.ndarray, hold: float) -> Visit:
        """Send a goal [2], m, wait until it is reached, and watch the tip for a while, s."""
        visit = Visit(goal, self._metadata.goal_tolerance, time.monotonic())
        self.tour.visits.append(visit)
        message = PointStamped()
        message.header.frame_id = self._metadata.goal_frame
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.point.x, message.point.y = goal.tolist()
        self._goals.publish(message)
        self._spin(lambda: False, _SETTLE)
        if self._spin(lambda: self._state == State.REACHED.value and self._distance(goal) < visit.tolerance, _PER_GOAL):
            visit.reached = time.monotonic()
            seen = len(self.tour.positions)
            self._spin(lambda: False, hold)
            held = self.tour.positions[seen:]
            visit.farthest = max((self._policy.distance(q, goal) for q in held), default=np.inf)
        return visit

    def _distance(self, goal: np.ndarray) -> float:
        return self._policy.distance(self.tour.positions[-1], goal)

    def _spin(self, done: Callable[[], object], seconds: float) -> bool:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(0.05)
            if done():
                return True
            for process in self.watch:
                if process.ended:
                    raise UserError(f"{process.module} has ended: {process.last_words()}")
        return False

    def _take_joint_state(self, message: JointState) -> None:
        index = [message.name.index(joint) for joint in self._metadata.joints]
        self.tour.times.append(time.monotonic())
        self.tour.positions.append(np.array(message.position)[index])

    def _take_state(self, message: String) -> None:
        self._state = message.data

    def __enter__(self) -> "Tourist":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()
