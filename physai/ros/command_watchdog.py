"""A relay before a controller that has no timeout: when commands stop, it goes on with zeros.

The inference node publishes to ~/commands (remap its /joint_velocity_controller/commands to
/command_watchdog/commands); this node passes commands on, and zeros when none has come for a while or another publisher
commands the controller. Run it on the robot's side of whatever may fail.
"""

import math
import sys
import time
from dataclasses import dataclass

from rclpy.clock import Clock, ClockType
from std_msgs.msg import Float64MultiArray

from physai.deploy.parameters import Parameters, parameter
from physai.ros import qos
from physai.ros.commands import VelocityCommands
from physai.ros.parameters import declare
from physai.ros.run import StoppableNode, run


@dataclass(frozen=True)
class WatchdogConfig(Parameters):
    """Parameters of the watchdog."""

    timeout: float = parameter(0.1, "without a command for this long, the arm stops", "s", 0.01, 10.0)
    rate_hz: float = parameter(50.0, "zeros per second", "Hz", 1.0, 1000.0, fixed=True)


class CommandWatchdog(StoppableNode):
    """Passes commands on while they come."""

    def __init__(self) -> None:
        super().__init__("command_watchdog")
        self._config = declare(self, WatchdogConfig, self._configure)
        self._commands: VelocityCommands | None = None  # until the first command tells how many joints there are
        self._joints = 0
        self._last = -math.inf
        self._reason = ""
        self.create_subscription(Float64MultiArray, "~/commands", self._relay, qos.COMMAND)
        self.create_timer(1.0 / self._config.rate_hz, self._check, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _configure(self, config: WatchdogConfig) -> None:
        self._config = config

    def _relay(self, message: Float64MultiArray) -> None:
        velocity = message.data.tolist()
        if self._commands is None:
            self._joints = len(velocity)
            self._commands = VelocityCommands(self, self._joints)
        self._last = time.monotonic()
        if len(velocity) != self._joints:
            self._stop(f"{len(velocity)} velocities for {self._joints} joints")
        elif not all(map(math.isfinite, velocity)):
            self._stop("a velocity that is not finite")
        elif rival := self._commands.rival:
            self._stop(f"another publisher commands {self._commands.topic}: {rival}")
        else:
            if self._reason:
                self.get_logger().info("passing commands on again")
            self._reason = ""
            self._commands.send(velocity)

    def _check(self) -> None:
        if self._commands is not None and time.monotonic() - self._last > self._config.timeout:
            self._stop(f"no command for {self._config.timeout:g} s")

    def _stop(self, reason: str) -> None:
        assert self._commands is not None
        if reason != self._reason:
            self.get_logger().error(f"zero velocity: {reason}")
        self._reason = reason
        self._commands.stop()

    def finish(self) -> None:
        """See that the last command that the robot got is zero."""
        if self._commands is not None:
            self._commands.finish()


def main() -> int:
    """Run the node."""
    return run(CommandWatchdog, "physai.ros.command_watchdog", __doc__ or "", WatchdogConfig)


if __name__ == "__main__":
    sys.exit(main())
