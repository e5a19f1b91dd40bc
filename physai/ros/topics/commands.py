"""Joint commands to a controller: is it there, is it ours alone, and do they end with one that stands still."""

import math
import time
from array import array
from collections.abc import Sequence

from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from physai.ros.topics import qos
from physai.ros.topics.companions import Companions
from physai.signals import Quantity

_LAST, _PERIOD = 5, 0.02  # s
_ACKNOWLEDGED = 0.5  # s


def controller_topic(quantity: Quantity) -> str:
    """Where ros2_control's controller of joint velocities or positions takes commands, in the robot's namespace."""
    return f"{quantity.value}_controller/commands"


class JointCommands:
    """Publishes std_msgs/Float64MultiArray, rad/s or rad, to a controller of ros2_control.

    Args:
        node: Whose remaps hold.
        joints: How many numbers a command has; 0 where that is not known yet.
        quantity: What they are, joint velocities or joint positions.
        topic: Where to; None for the controller itself.
        partners: Who publishes this other topic may publish here, too; empty if nobody may.

    Attributes:
        timeout: A way to the controller that was silent for longer is lost, s; of use where it tells that it lives.
        silences: How often it was lost.
        still: The command that stands still: zero velocities, or positions that whoever commands keeps up to date;
            None while these are not known.
    """

    timeout, silences = math.inf, 0

    still: Sequence[float] | None

    def __init__(
        self, node: Node, joints: int, quantity: Quantity, topic: str | None = None, partners: str = ""
    ) -> None:
        self.still = [0.0] * joints if joints and quantity is Quantity.JOINT_VELOCITY else None
        self._publisher = node.create_publisher(
            Float64MultiArray, topic or controller_topic(quantity), qos.COMMAND, event_callbacks=qos.SILENT_PUBLISHER
        )
        self.topic: str = self._publisher.topic_name
        self._companions = Companions(node, self.topic, partners)
        self._message = Float64MultiArray()

    @property
    def rival(self) -> str | None:
        """That another publisher commands, and who; or None."""
        others = self._companions.others()
        return f"another publisher commands {self.topic}: {', '.join(others)}" if others else None

    def silence(self, now: float) -> str | None:
        """That commands are lost on their way at a time, s, though somebody listens; or None."""
        return None

    @property
    def unheard(self) -> str | None:
        """That no controller listens, or None."""
        return None if self._publisher.get_subscription_count() else f"no controller listens to {self.topic}"

    @property
    def lost(self) -> bool:
        """Whether not even a command that stands still reaches a controller."""
        return self.unheard is not None

    @property
    def arrived(self) -> bool:
        """Whether all who are known to listen have the last command.

        A reliable listener that was just found may not have found the publisher yet. It misses what is sent until then.
        """
        return self._publisher.wait_for_all_acked(Duration())

    def send(self, command: Sequence[float]) -> None:
        """Publish a command."""
        self._message.data = array("d", command)
        self._publisher.publish(self._message)

    def stop(self) -> None:
        """Publish the command that stands still, if it is known: a position that is made up would move the arm."""
        if self.still is not None:
            self.send(self.still)

    def finish(self) -> None:
        """Stop until this has surely arrived: a reliable writer of depth 1 forgets what it has replaced."""
        for _ in range(_LAST):
            self.stop()
            time.sleep(_PERIOD)
        self.wait()

    def wait(self) -> None:
        """Wait until the last command has arrived where it can, for half a second at most."""
        self._publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGED))
