"""The other side of the nodes under test: real processes, and a node of ours that sends, listens and remembers."""

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger

from physai.processes import die_with
from physai.ros.topics import qos
from physai.ros.topics.commands import controller_topic
from physai.signals import Quantity
from tests.waiting import wait_for

SHM = Path("/dev/shm")

TOPIC = f"/{controller_topic(Quantity.JOINT_VELOCITY)}"

_ASKED, _ANSWER = 3, 5.0  # how often a service is called at most, and s for an answer


class Process:
    """A node in a process of its own, which dies with this one; its output is read as it comes."""

    def __init__(self, command: Sequence[str], domain: int, env: dict[str, str] | None = None) -> None:
        self.command = list(command)
        self.lines: list[str] = []
        self._popen = subprocess.Popen(
            self.command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1", **(env or {})},
            preexec_fn=partial(die_with, os.getpid()),
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._popen.stdout is not None
        for line in self._popen.stdout:
            self.lines.append(line.rstrip())

    @property
    def output(self) -> str:
        return "\n".join(self.lines)

    @property
    def pid(self) -> int:
        return self._popen.pid

    def poll(self) -> int | None:
        """Exit code, or None while it runs."""
        return self._popen.poll()

    def says(self, text: str, timeout: float = 60.0) -> str:
        """Wait for a line with this text, and return it."""

        def found() -> str | None:
            return next((line for line in self.lines if text in line), None)

        wait_for(lambda: found() or self.poll() is not None, timeout, f"{text!r} in:\n{self.output}")
        if self.poll() is not None:
            self.wait()
        line = found()
        assert line is not None, f"ended with {self.poll()} without {text!r}:\n{self.output}"
        return line

    def signal(self, number: int) -> None:
        self._popen.send_signal(number)

    def wait(self, timeout: float = 60.0) -> int:
        """Wait for its end, and return its exit code."""
        code = self._popen.wait(timeout)
        self._reader.join(2.0)
        return code

    def end(self) -> None:
        """Make sure that it is gone: politely, so that it tidies up, and then not."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._popen.pid, signal.SIGCONT)
            os.killpg(self._popen.pid, signal.SIGTERM)
        try:
            self._popen.wait(5)
        except subprocess.TimeoutExpired:
            os.killpg(self._popen.pid, signal.SIGKILL)
            self._popen.wait(10)
        self._reader.join(2.0)


def node_command(module: str, *args: str, **parameters: Any) -> list[str]:
    """Command line of a node: parameters by name, everything else as it stands after --ros-args."""
    if module in ("inference_node", "tests.ros.raising_node"):
        # On a machine that is busy with tests a policy may well take 10 ms three times in a row, which is a fault.
        parameters = {"policy_timeout": 0.1, **parameters}
    command = [sys.executable, "-m", f"physai.ros.{module}", "--ros-args"]
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        command += ["-p", f"{name}:={text}"]
    return command + list(args)


class Peer:
    """A node in this process that remembers what it hears, each with the time at which it came.

    Attributes:
        commands: (time, velocities) of every command on the controller's topic.
        states: (time, text) of the inference node's ``~/state``.
        joint_states: (time, message).
        diagnostics: (time, message) of every ``/diagnostics``.
    """

    def __init__(self, domain: int, listen_to_commands: bool = True) -> None:
        self.domain = domain
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node("peer", context=self._context)
        self.commands: list[tuple[float, list[float]]] = []
        self.states: list[tuple[float, str]] = []
        self.joint_states: list[tuple[float, JointState]] = []
        self.diagnostics: list[tuple[float, DiagnosticArray]] = []
        if listen_to_commands:
            # Deep, so that no command is missed; a controller would only look at the last.
            self.listen(Float64MultiArray, TOPIC, self.commands, 1000, lambda message: message.data.tolist())
        self.listen(String, "/inference_node/state", self.states, qos.LATCHED, lambda message: message.data)
        self.listen(JointState, "/joint_states", self.joint_states, 10)
        self.listen(DiagnosticArray, "/diagnostics", self.diagnostics, 10)
        self._publishers: dict[tuple[Any, ...], Any] = {}
        self._clients: dict[str, Any] = {}
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            pass
        except (RuntimeError, AttributeError):
            # RCLError, or rclpy's own slip: the context ended while it began to wait.
            if self._context.ok():
                raise

    def listen(
        self,
        kind: type,
        topic: str,
        into: list[Any],
        profile: QoSProfile | int,
        read: Callable[[Any], Any] = lambda message: message,
    ) -> Any:
        """Append (time, what ``read`` makes of the message) for every message."""
        return self.node.create_subscription(
            kind, topic, lambda message: into.append((time.monotonic(), read(message))), profile
        )

    def remove(self, entity: Publisher | Subscription | Timer) -> None:
        """Destroy it in the thread that spins: in another one, the executor may just be about to wait for it."""
        name = f"destroy_{type(entity).__name__.lower()}"  # of a Publisher, a Subscription, a Timer
        task = self._executor.create_task(getattr(self.node, name), entity)
        wait_for(task.done, what=f"the end of {entity}")

    def publisher(self, kind: type, topic: str, profile: QoSProfile | int = 10) -> Any:
        key = (kind, topic, str(profile))
        if key not in self._publishers:
            self._publishers[key] = self.node.create_publisher(kind, topic, profile)
        return self._publishers[key]

    def publish(self, topic: str, message: Any, profile: QoSProfile | int = 10) -> None:
        """Publish once somebody listens."""
        publisher = self.publisher(type(message), topic, profile)
        wait_for(publisher.get_subscription_count, what=f"a listener to {topic}")
        publisher.publish(message)

    def send_goal(self, x: float, y: float, frame: str = "base") -> None:
        message = PointStamped()
        message.header.frame_id = frame
        message.point.x, message.point.y = x, y
        self.publish("/inference_node/goal", message)

    def emergency_stop(self, pressed: bool = True) -> None:
        self.publish("/emergency_stop", Bool(data=pressed))

    def release_emergency_stop(self) -> None:
        """Say that it is not pressed, and wait until all have heard it: who presses it next is heard at once."""
        self.emergency_stop(False)
        assert self.publisher(Bool, "/emergency_stop").wait_for_all_acked(Duration(seconds=10))

    def call(self, service: str, request: Any = None) -> Any:
        """Call a service, std_srvs/Trigger unless a request says otherwise, and return its answer."""
        request = request or Trigger.Request()
        kind = SetBool if isinstance(request, SetBool.Request) else Trigger
        return self.call_service(kind, service, request)

    def call_service(self, kind: type, service: str, request: Any, timeout: float = 60.0) -> Any:
        """Call a service; ask again where no answer comes: one to a client that was not found yet may be lost."""
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service)
        client, futures = self._clients[service], []
        wait_for(client.service_is_ready, timeout, f"service {service}")
        began = time.monotonic()

        def answered() -> Any:
            if len(futures) < _ASKED and time.monotonic() >= began + len(futures) * _ANSWER:
                futures.append(client.call_async(request))
            return next((future for future in futures if future.done()), None)

        return wait_for(answered, timeout, f"answer of {service}").result()

    def enable(self, on: bool = True) -> SetBool.Response:
        return self.call("/inference_node/enable", SetBool.Request(data=on))

    def wait_state(self, *names: str, timeout: float = 30.0, after: float = 0.0) -> tuple[float, str]:
        """Wait until the node's last announced state is one of these (announced after a time, if given)."""

        def there() -> tuple[float, str] | None:
            last = self.states[-1] if self.states else None
            return last if last and last[1] in names and last[0] >= after else None

        def instead() -> str:
            joints = [(at, list(message.position)) for at, message in self.joint_states[-1:]]
            heard = f"{len(self.commands)} commands, {len(self.joint_states)} joint states"
            told = [status.message for _, message in self.diagnostics[-1:] for status in message.status]
            return f"state {names}; had {self.states[-5:]}, {told}; {heard}, the last {self.commands[-1:]}, {joints}"

        return wait_for(there, timeout, instead)

    def set_parameters(self, node: str, **values: Any) -> list[SetParametersResult]:
        """Ask a node to change parameters, each for itself."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParameters.Request(parameters=parameters)
        return self.call_service(SetParameters, f"{node}/set_parameters", request).results

    def moved(self, after: float = 0.0, commands: int = 5) -> float:
        """Wait for commands that move the arm and came after a time; return the time of the last of them."""

        def found() -> list[float] | None:
            times = [at for at, velocity in list(self.commands) if at > after and any(velocity)]
            return times if len(times) >= commands else None

        return wait_for(found, 60.0, "an arm that is told to move")[-1]

    def moved_on(self, after: float, commands: int = 50) -> None:
        """Wait for so many commands in a row that all move the arm; a stalled computer's pause only starts anew."""

        def found() -> bool:
            last = self._after(after)[-commands:]
            return len(last) == commands and all(any(velocity) for velocity in last)

        wait_for(found, 8.0, f"{commands} commands in a row that move the arm")

    def first_zeros(self, after: float, timeout: float = 20.0) -> float:
        """Wait for a command of zeros that came after a time, and return how much later it came."""

        def found() -> float | None:
            return next((at for at, velocity in reversed(self.commands) if at > after and not any(velocity)), None)

        wait_for(found, timeout, "zeros")
        return next(at for at, velocity in self.commands if at > after and not any(velocity)) - after

    def all_zeros(self, after: float, commands: int = 10) -> None:
        """See that all commands after a time are zeros, until enough have come."""
        came = wait_for(lambda: len(found := self._after(after)) >= commands and found, 20.0, "more commands")
        assert not any(any(velocity) for velocity in came), came

    def _after(self, after: float) -> list[list[float]]:
        return [velocity for at, velocity in list(self.commands) if at > after]

    def silent(self, seconds: float = 0.2) -> None:
        """Wait until no command has come for a while: those that were under way are here."""
        since = time.monotonic()
        wait_for(lambda: time.monotonic() - max([since, *(at for at, _ in self.commands[-1:])]) > seconds)

    def close(self) -> None:
        self._executor.shutdown()
        self._context.try_shutdown()
        self._thread.join(5.0)
        self.node.destroy_node()


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """A domain id that no other test on this machine uses now."""
    for domain in range(1, 100):
        with open(f"/tmp/physai-test-domain-{domain}.lock", "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    raise RuntimeError("all domains are taken")


def mapped_segments(pid: str = "[0-9]*") -> set[Path]:
    """Fast DDS' shared memory that living processes use."""
    found = set()
    for maps in Path("/proc").glob(f"{pid}/maps"):
        with contextlib.suppress(OSError):  # it has just ended, or is another user's
            found.update(Path(line.split()[-1]) for line in maps.read_text().splitlines() if "/fastrtps_" in line)
    return found


def remove_dead_segments() -> list[str]:
    """Remove Fast DDS' shared memory of processes that were killed; the living hold a lock on theirs, or map it."""
    removed, unlocked = [], []

    def remove(segment: Path) -> None:
        for path in (segment.with_name(f"{segment.name}_el"), segment, SHM / f"sem.{segment.name}_mutex"):
            with contextlib.suppress(FileNotFoundError, PermissionError):
                path.unlink()
                removed.append(path.name)

    for segment in SHM.glob("fastrtps_*[0-9a-f]"):
        try:
            with open(segment.with_name(f"{segment.name}_el")) as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            remove(segment)
        except (BlockingIOError, PermissionError):
            continue
        except FileNotFoundError:
            unlocked.append(segment)
    if unlocked:
        # A port without a reader; or one so new that it has no lock yet.
        before = mapped_segments()
        time.sleep(0.2)
        for segment in set(unlocked) - before - mapped_segments():
            remove(segment)
    return removed
