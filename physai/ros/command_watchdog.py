"""A relay before a controller that has no timeout: when commands stop, it stops the arm.

The inference node (with -p watchdog:=command_watchdog) publishes to ~/commands; this node passes commands on. It stops
the arm when none has come for a while, and, until ~/reset, when another publisher has commanded the controller, one
that does not publish ~/commands, too. It listens only while a controller listens to it, so that who commands it knows.
It publishes ~/heartbeat while it can hear them, so that who commands it can stop the arm when it hangs or dies. Run it
on the robot's side of whatever may fail.
"""

import math
import sys
import time
from dataclasses import dataclass

from rclpy.subscription import Subscription
from std_msgs.msg import Empty, Float64MultiArray

from physai.deploy.parameters import Parameters, parameter
from physai.ros.node.run import StoppableNode, run
from physai.ros.topics import qos
from physai.ros.topics.commands import JointCommands
from physai.signals import Quantity


@dataclass(frozen=True)
class WatchdogConfig(Parameters):
    """Parameters of the watchdog."""

    timeout: float = parameter(0.1, "without a command for this long, the arm stops", "s", 0.01, 10.0)
    rate_hz: float = parameter(50.0, "stops per second, and heartbeats", "Hz", 1.0, 1000.0, fixed=True)
    joints: int = parameter(
        0, "velocities in a command: zeros come from the start; 0: from the first command on", "", 0, 1000, fixed=True
    )
    command: str = parameter(
        "joint_velocity",
        "what commands are; an arm is stopped by zero velocities, or by the positions that it was sent to last",
        choices=("joint_velocity", "joint_position"),
        fixed=True,
    )


class CommandWatchdog(StoppableNode[WatchdogConfig]):
    """Passes commands on while they come.

    Args:
        arguments: ROS arguments of this node alone; None takes those of the command line.
    """

    def __init__(self, arguments: list[str] | None = None) -> None:
        super().__init__("command_watchdog", WatchdogConfig, arguments)
        config = self.config
        # Before the commands: who hears of these knows then that they are ours.
        self._heartbeat = self.create_publisher(Empty, "~/heartbeat", qos.COMMAND, event_callbacks=qos.SILENT_PUBLISHER)
        self._commands = JointCommands(self, config.joints, Quantity(config.command), partners="~/commands")
        self._joints = config.joints
        self._positions = config.command == Quantity.JOINT_POSITION
        self._source: Subscription | None = None
        self._last = -math.inf
        self._looked = time.monotonic()
        self._deaf_until = -math.inf
        self._conflict = ""
        self._reason = ""
        self.offer("~/reset", self._reset)
        source = self.resolve_topic_name("~/commands")
        self.get_logger().info(f"passing commands from {source} to {self._commands.topic}")
        self.every(1.0 / config.rate_hz, self._check)

    def _relay(self, message: Float64MultiArray, info: dict[str, int]) -> None:
        self._look()
        command = message.data.tolist()
        sound = len(command) > 0 and all(map(math.isfinite, command))
        if not self._joints and sound:
            self._joints = len(command)
            self._commands.still = None if self._positions else [0.0] * self._joints
        if time.monotonic() < self._deaf_until:
            return
        self._last = qos.received_at(info)
        if self._conflict:
            self._stop(self._conflict)
        elif not sound or len(command) != self._joints:
            self._stop(f"{command} is no command for {self._joints} joints")
        else:
            self._commands.send(command)
            if self._positions:
                self._commands.still = command
            if self._reason:
                self.get_logger().info("passing commands on again")
            self._reason = ""

    def _check(self) -> None:
        self._look()
        heard = self._commands.unheard is None
        # The zeros of the check before: a controller that missed the beginning of a motion would jump into it.
        arrived = self._source is None and self._commands.arrived
        if self._conflict:
            self._stop(self._conflict)
        elif time.monotonic() - self._last > self.config.timeout:
            self._stop(f"no command for {self.config.timeout:g} s")
        # Not while commands would be lost: the arm would miss the beginning of a motion, or seem not to follow.
        passing = time.monotonic() >= self._deaf_until and not self._conflict
        if passing and self._source is not None and self._source.get_publisher_count():
            self._heartbeat.publish(Empty())
        if heard and arrived:
            self._source = self.create_subscription(
                Float64MultiArray,
                "~/commands",
                self._relay,  # type: ignore[arg-type]  # rclpy also takes callbacks with two arguments
                qos.COMMAND,
            )
        elif not heard and self._source is not None:
            self.destroy_subscription(self._source)
            self._source = None

    def _look(self) -> None:
        now = time.monotonic()
        if now - self._looked > self.config.timeout:
            # This process stood still: what has waited for it is old, and its sender may be gone.
            self._deaf_until = now + self.config.timeout
        self._looked = now
        if rival := self._commands.rival:
            self._conflict = f"{rival}; until ~/reset"

    def _reset(self) -> tuple[bool, str]:
        self._conflict = ""
        self._look()
        return not self._conflict, self._conflict

    def _stop(self, reason: str) -> None:
        if self._commands.still is None:  # positions are known only once some have been passed on
            return
        self._commands.stop()
        if reason != self._reason:
            self.get_logger().error(f"{'held' if self._positions else 'zero velocity'}: {reason}")
        self._reason = reason

    def finish(self) -> None:
        """See that the last command that the robot got stands still."""
        self._commands.finish()


def main() -> int:
    """Run the node."""
    return run(CommandWatchdog, "physai.ros.command_watchdog", __doc__ or "", WatchdogConfig)


if __name__ == "__main__":
    sys.exit(main())
