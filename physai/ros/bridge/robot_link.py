"""One robot's topics for code that is no node: joint states in, velocity commands out, on a thread of their own."""

import contextlib
import math
import threading
import time
from collections.abc import Sequence

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from physai.errors import UserError
from physai.ros.node.guest import Guest
from physai.ros.topics import joint_states, qos
from physai.ros.topics.commands import JointCommands
from physai.signals import Quantity

_DISCOVERY = 3.0  # s until all rivals are known, those without our settings of Fast DDS, too; 2.9 were measured
_PATIENCE = 5.0  # s; for a robot to appear, a rival to leave, a service to answer


class RobotError(UserError):
    """The robot does not answer as it must; it has been told to stop."""


class RobotLink:
    """Commands a robot from any thread.

    It has a ROS context of its own, and leaves signals alone. The controllers of robots hold the last velocity for
    ever: when the caller falls silent, zeros go out in its place, and ``close`` sees that zeros have arrived.

    Args:
        joints: Names of the n joints, in the order in which the controller takes velocities.
        silence: After so long without a command the arm is stopped, s: its caller does not look where it goes.
        reset_service: A std_srvs/Trigger service that puts a virtual robot home; None for a robot without.
        remap: ROS remap rules, such as ``/joint_states:=/left/joint_states``.

    Raises:
        UserError: If ROS cannot start.
    """

    def __init__(self, joints: Sequence[str], silence: float, reset_service: str | None, remap: Sequence[str]) -> None:
        self._joints = tuple(joints)
        self._silence = silence
        self._guest = Guest("physai_env", remap)
        node = self._guest.node
        self._news = threading.Condition()  # also guards what goes out
        self._received, self._stamp, self._refused = -math.inf, -1, ""
        self._state = np.full((2, len(self._joints)), np.nan)
        self._sent, self._moving, self._closed = -math.inf, False, False
        self._commands = JointCommands(node, len(self._joints), Quantity.JOINT_VELOCITY)
        self._states = node.create_subscription(
            JointState,
            joint_states.TOPIC,
            self._take,  # type: ignore[arg-type]  # rclpy also takes callbacks with two arguments
            qos.SENSOR,
            event_callbacks=qos.SILENT_SUBSCRIPTION,  # a log line on a stopped terminal would stop _watch, too
        )
        self._reset = None if reset_service is None else node.create_client(Trigger, reset_service)
        node.create_timer(silence / 2, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._thread = threading.Thread(target=self._spin, name="physai_env", daemon=True)
        self._thread.start()
        self._started = time.monotonic()

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._guest.executor.spin()

    def _take(self, message: JointState, info: dict[str, int]) -> None:
        received = qos.received_at(info)
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        state = _read(message, self._joints)
        with self._news:
            if isinstance(state, str):
                self._refused = state
            elif stamp == self._stamp:
                self._refused = "its stamp is that of the one before"
            else:
                self._received, self._stamp, self._state, self._refused = received, stamp, state, ""
            self._news.notify_all()

    def _watch(self) -> None:
        with self._news:
            if self._moving and not self._closed and time.monotonic() - self._sent > self._silence:
                self.stop()

    def wait_ready(self) -> None:
        """Wait for a controller that obeys us alone, and for a joint state that can be used.

        Raises:
            RobotError: If they do not come within some seconds; the line says what is missing.
        """
        start = time.monotonic()
        while lacking := self._lacking(start):
            if time.monotonic() - start > _PATIENCE:
                raise RobotError(lacking)
            time.sleep(0.01)

    def _lacking(self, start: float) -> str | None:
        if time.monotonic() - self._started < _DISCOVERY:
            return "looking for the robot"
        if self._received < start:
            return self._no_state(_PATIENCE)
        return self.obstacle

    @property
    def obstacle(self) -> str | None:
        """Why commands must not be sent, or None."""
        return self._commands.rival or self._commands.unheard

    def _no_state(self, seconds: float) -> str:
        why = f" that can be used: {self._refused}" if self._refused else ""
        return f"no joint state came on {self._states.topic_name} within {seconds:g} s{why}"

    def send(self, velocity: Sequence[float]) -> float:
        """Publish velocities [n], rad/s; return the time at which it was done (``time.monotonic``)."""
        with self._news:
            if self._closed:
                raise RobotError("the link to the robot is closed")
            self._moving = any(velocity)
            self._sent = time.monotonic()
            self._commands.send(velocity)
            return self._sent

    def stop(self) -> float:
        """Publish zeros; return the time."""
        return self.send([0.0] * len(self._joints))

    def state(self, after: float, timeout: float) -> np.ndarray:
        """Wait for a joint state that was received after a time; return positions, rad, and velocities, rad/s, [2, n].

        Raises:
            RobotError: If none came within ``timeout`` seconds that can be used, and why.
        """
        with self._news:
            if not self._news.wait_for(lambda: self._received > after, timeout):
                raise RobotError(self._no_state(timeout))
            return self._state

    def reset(self) -> bool:
        """Call the reset service; False if nobody offers it.

        Raises:
            RobotError: If it fails.
        """
        if self._reset is None or not self._reset.service_is_ready():
            return False
        answer = self._reset.call(Trigger.Request(), _PATIENCE)
        if answer is None:
            raise RobotError(f"{self._reset.service_name} did not answer within {_PATIENCE:g} s")
        if not answer.success:
            raise RobotError(f"{self._reset.service_name} failed: {answer.message}")
        return True

    def close(self) -> None:
        """Stop the robot, surely, and leave ROS."""
        try:
            with self._news:
                self._closed = True  # nobody speaks after the last zeros
                if self._sent > -math.inf:  # else another one may drive it
                    self._commands.finish()
        finally:
            self._guest.executor.shutdown(timeout_sec=1.0)
            if threading.current_thread() is not self._thread:  # the garbage collector runs in any thread
                self._thread.join(1.0)
            self._guest.close()


def _read(message: JointState, joints: tuple[str, ...]) -> np.ndarray | str:
    """Return positions and velocities [2, n] of these joints, or why that is impossible."""
    names = list(message.name)
    for joint in joints:
        if names.count(joint) != 1:
            return f"joint '{joint}' is {'named twice' if joint in names else 'missing'}"
    if not len(names) == len(message.position) == len(message.velocity):
        return f"{len(names)} names, {len(message.position)} positions and {len(message.velocity)} velocities"
    index = [names.index(joint) for joint in joints]
    state = np.array([message.position, message.velocity], dtype=np.float64)[:, index]
    return state if np.isfinite(state).all() else "a position or velocity is not finite"
