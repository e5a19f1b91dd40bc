"""A closed loop: the inference node in its process, and a robot in that of the tests."""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from tests.ros.forge import forged
from tests.ros.peer import Peer, Process, free_domain
from tests.waiting import wait_for

FAR = (-0.3, -0.2)  # m; ten seconds from home at 0.3 rad/s


class Arm:
    """A robot in this process: it does at once what it is told, and tells where it is, 100 times a second.

    Args:
        peer: Whose node it uses.
        profile: Quality of service of its joint states.
        rate: Joint states per second.

    Attributes:
        position: rad; may be set.
        change: What makes the message that is sent (or None, for no message) of the true one.
        sent: Times of the last messages.
    """

    NAMES = ("joint1", "joint2")
    HOME = (0.0, 0.5)

    def __init__(self, peer: Peer, profile: QoSProfile | int = 10, rate: float = 100.0) -> None:
        self._peer = peer
        self.sent: list[float] = []
        self._publisher = peer.node.create_publisher(JointState, "/joint_states", profile)
        self._at = time.monotonic()
        self.go_home()
        self._timer = peer.node.create_timer(1 / rate, self._step, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def go_home(self) -> None:
        self.position = list(self.HOME)
        self.change: Callable[[JointState], JointState | None] = lambda message: message

    def pause(self) -> float:
        """Send no more joint states; return when the last one was sent."""
        self.change = lambda message: None
        return self.sent[-1]

    def _step(self) -> None:
        now = time.monotonic()
        elapsed, self._at = now - self._at, now
        velocity = self._peer.commands[-1][1] if self._peer.commands else [0.0] * len(self.NAMES)
        self.position = [q + v * elapsed for q, v in zip(self.position, velocity, strict=True)]
        message = JointState(name=self.NAMES, position=self.position, velocity=velocity)
        nanoseconds = time.time_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        changed = self.change(message)
        if changed is not None:
            self.publish(changed)

    def publish(self, message: JointState) -> None:
        """Send it."""
        self.sent.append(time.monotonic())
        self._publisher.publish(message)

    def leave(self) -> None:
        """Neither tell nor hear anything any more."""
        self._peer.remove(self._timer)
        self._peer.remove(self._publisher)


class Loop:
    """The inference node in its process, and a robot in this one.

    Attributes:
        peer: Hears everything.
        arm: The robot.
        node: The inference node's process.
    """

    def __init__(self, peer: Peer, node: Process, profile: QoSProfile | int, rate: float) -> None:
        self.peer, self.node = peer, node
        self.arm = Arm(self.peer, profile, rate)

    def diagnosis(self, after: float | None = None) -> tuple[int, str, dict[str, str]]:
        """Wait for diagnostics of after a time (now, if none is given); return level, message and values."""
        after = time.monotonic() if after is None else after

        def there() -> Any:
            return self.peer.diagnostics[-1] if self.peer.diagnostics and self.peer.diagnostics[-1][0] > after else None

        status = wait_for(there, what="/diagnostics")[1].status[0]
        return status.level[0], status.message, {item.key: item.value for item in status.values}

    def rest(self) -> None:
        """Bring the arm home, and the node to wait for a goal."""
        self.peer.call("/inference_node/estop")
        self.arm.go_home()
        since = time.monotonic()
        wait_for(lambda: self.peer.call("/inference_node/reset").success, what="a reset")
        self.peer.wait_state("waiting", after=since)
        wait_for(lambda: self.peer.enable().success, what="permission to move")

    def start(self) -> float:
        """Begin a long way from home; return the time of a command that moves."""
        self.rest()
        return self.start_from_here()

    def start_from_here(self) -> float:
        """Begin a long way; return the time of a command that moves."""
        since = time.monotonic()
        self.peer.send_goal(*FAR)
        return self.peer.moved(after=since)


@contextlib.contextmanager
def closed_loop(
    policy_path: Path,
    *args: str,
    profile: QoSProfile | int = 10,
    rate: float = 100.0,
    peer: Peer | None = None,
    module: str = "inference_node",
    state: Path | None = None,
    output: Path | None = None,
    finalize: bool = False,
    **parameters: Any,
) -> Iterator[Loop]:
    """Run the inference node with an arm, in a domain of its own or in that of a peer; see :func:`forged`."""
    with contextlib.ExitStack() as stack:
        if peer is None:
            peer = Peer(stack.enter_context(free_domain()))
            stack.callback(peer.close)
        parameters = {"policy_path": policy_path, "autostart": True, **parameters}
        node = forged(module, peer.domain, *args, state=state, output=output, finalize=finalize, **parameters)
        stack.callback(node.end)
        yield Loop(peer, node, profile, rate)
