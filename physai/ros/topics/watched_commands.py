"""Joint commands by way of a watchdog, and past it while it does not answer: those alone that stand still."""

import math
import time
from collections.abc import Sequence

from rclpy.node import Node
from std_msgs.msg import Empty

from physai.ros.topics import qos
from physai.ros.topics.commands import JointCommands
from physai.ros.topics.unawaited import Unawaited, nobody, waiting
from physai.signals import Quantity


class WatchedCommands(JointCommands):
    """Publishes to a command_watchdog, which tells that it lives; and, when it does not, stops the controller itself.

    Args:
        node: Whose remaps hold.
        joints: How many numbers a command has.
        quantity: What they are, joint velocities or joint positions.
        watchdog: Name of its node, such as ``command_watchdog``.
        timeout: A watchdog that was silent for longer does not answer, s.

    Attributes:
        silences: How often it has ceased to answer.
    """

    def __init__(self, node: Node, joints: int, quantity: Quantity, watchdog: str, timeout: float) -> None:
        super().__init__(node, joints, quantity, f"{watchdog}/commands")
        # There from the start: what has to be found first is late.
        self._past = JointCommands(node, joints, quantity, partners=f"{watchdog}/heartbeat")
        self._heartbeat = node.create_subscription(
            Empty, f"{watchdog}/heartbeat", nobody, qos.SENSOR, callback_group=Unawaited()
        )
        self.timeout = timeout
        self._name = watchdog
        self._last = -math.inf
        self._answering = False

    @property
    def rival(self) -> str | None:
        """That another publisher commands the watchdog or the controller, and who; or None."""
        return super().rival or self._past.rival

    def silence(self, now: float) -> str | None:
        """That the watchdog does not answer at a time, s; or None."""
        for _, info in waiting(self._heartbeat):
            self._last = qos.received_at(info)
        before, self._answering = self._answering, now - self._last <= self.timeout
        self.silences += before and not self._answering
        return None if self._answering else f"the watchdog {self._name} does not answer, or waits for its ~/reset"

    @property
    def lost(self) -> bool:
        """See :class:`JointCommands`; what stands still goes past a watchdog that is not there."""
        return self._past.unheard is not None and (not self._answering or self.unheard is not None)

    def send(self, command: Sequence[float]) -> None:
        """Publish a command; while the watchdog does not answer, or does not listen, stop past it first."""
        if time.monotonic() - self._last > self.timeout or self.unheard is not None:
            self._past.still = self.still
            self._past.stop()
        super().send(command)

    def finish(self) -> None:
        """Stop on both ways until this has surely arrived: the watchdog may just have ceased to answer."""
        self._last = -math.inf
        super().finish()
        self._past.wait()
