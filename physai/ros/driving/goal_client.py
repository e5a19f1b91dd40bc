"""Sending an arm from goal to goal over ROS 2, and seeing what it does."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from sensor_msgs.msg import JointState

from physai.deploy import Policy, State
from physai.ros.driving.client import Client
from physai.ros.topics import joint_states, qos
from physai.signals import Tolerance

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


class GoalClient(Client):
    """Sends an arm to goals, and watches its joint states.

    Args:
        policy: Tells how far the robot is from a goal.

    Attributes:
        record: What happened so far.
    """

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy.metadata, "goal_client")
        self.record = Record()
        self._policy = policy
        self.node.create_subscription(JointState, joint_states.TOPIC, self._take_joint_state, qos.SENSOR)

    def wait_until_ready(self) -> None:
        """Wait for joint states, and for a node that waits for a goal.

        Raises:
            UserError: If they do not come.
        """
        self.wait_until("joint states", lambda: self.record.times, (State.WAITING.value, State.REACHED.value))

    def drive(self, goals: int, hold: float, seed: int) -> Iterator[tuple[str, bool]]:
        """See :class:`Client`; goals are drawn from those that the policy was trained on."""
        for goal in self._metadata.region.sample(goals, torch.Generator().manual_seed(seed)):
            result = self.send(goal, hold)
            yield result.describe(), result.kept

    def done(self, hold: float) -> str:
        """See :class:`Client`."""
        return f"goals reached, and held for {hold:g} s"

    def draw(self, output: Path) -> None:
        """See :class:`Client`."""
        from physai.plots.drive import draw_drive

        draw_drive(self.record, self._policy, output)

    def send(self, goal: np.ndarray, hold: float) -> GoalResult:
        """Send a goal [g], wait until it is reached, and watch the robot for a while, s.

        Raises:
            UserError: If the node stops the robot for good, or one of the processes has ended.
        """
        result = GoalResult(goal, self._metadata.goal.unit, self._metadata.tolerances, time.monotonic())
        self.record.results.append(result)
        self.publish(goal.tolist())
        self.spin(lambda: False, _SETTLE)
        if self.spin(lambda: self.state == State.REACHED.value and result.within(self._error(-1, goal)), _PER_GOAL):
            result.reached = time.monotonic()
            seen = len(self.record.positions)
            self.spin(lambda: False, hold)
            held = range(seen, len(self.record.positions))
            result.error = np.max([self._error(index, goal) for index in held], axis=0) if held else None
        return result

    def _error(self, index: int, goal: np.ndarray) -> np.ndarray:
        return self._policy.error(self.record.positions[index], goal)

    def _take_joint_state(self, message: JointState) -> None:
        index = [message.name.index(joint) for joint in self._metadata.joints]
        self.record.times.append(time.monotonic())
        self.record.positions.append(np.array(message.position)[index])
