"""The inference node's clock, its answer to a joint state, its load and its start, beside a bare rclpy node."""

import os
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

from physai.artifact import FILES
from physai.bench.policy import make_run
from physai.bench.timing import cpu_seconds, table
from physai.deploy import read_metadata
from physai.errors import UserError
from physai.ros.driving.processes import NodeProcess
from physai.ros.node.guest import Guest
from physai.ros.topics import qos
from physai.ros.topics.commands import controller_topic
from physai.signals import Quantity

PERIOD_SECONDS = 60.0
LATENCY_SECONDS = 20.0
STARTS = 5
STATE_RATE = 100.0  # Hz
_PATIENCE = 30.0
_NODE, _BARE = "physai.ros.inference_node", "physai.bench.bare_node"

TOPIC = controller_topic(Quantity.JOINT_VELOCITY)


@dataclass
class RosFigures:
    """Figures of one node.

    Attributes:
        periods: Between its messages, by its own clock, s.
        latencies: From a joint state to the answer, both by the clock of who sends and gets them, s.
        cpu: Share of a core.
        starts: From the start of the process to its first message, s.
    """

    periods: np.ndarray
    latencies: np.ndarray
    cpu: float
    starts: np.ndarray


class _Listener:
    """A node in this process, spun in the foreground."""

    def __init__(self) -> None:
        self._guest = Guest("bench")
        self.node = self._guest.node

    def listen(self, topic: str, kind: Any = Float64MultiArray, profile: Any = 100) -> list[tuple[float, int]]:
        """Collect (time of arrival, s, and the sender's time of sending, ns) of all messages to come."""
        heard: list[tuple[float, int]] = []

        def take(_: Any, info: dict[str, int]) -> None:
            heard.append((time.monotonic(), info["source_timestamp"]))

        self.node.create_subscription(kind, topic, take, profile)  # type: ignore[arg-type]
        return heard

    def spin(self, done: Callable[[], object], seconds: float) -> bool:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._guest.executor.spin_once(max(0.0, min(0.05, end - time.monotonic())))
            if done():
                return True
        return False

    def close(self) -> None:
        self._guest.close()


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return ros_table(measure_ros(options.seed))


def measure_ros(seed: int) -> dict[str, RosFigures]:
    """Measure the inference node and a bare rclpy node, at the same time wherever both have a part.

    Raises:
        UserError: If a node does not start.
    """
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # no robot shall hear of this
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder)
        make_run(run, seed, ["torchscript"])
        policy = run / FILES["torchscript"]
        joints = read_metadata(policy).joints
        listener = _Listener()
        try:
            if listener.node.count_subscribers(TOPIC):
                raise UserError(f"another node uses {TOPIC} here: choose another ROS_DOMAIN_ID")
            print(f"Listening to both nodes for {PERIOD_SECONDS:g} s ...", flush=True)
            periods, cpu = _periods(listener, policy, run)
            print(f"Sending joint states for {LATENCY_SECONDS:g} s ...", flush=True)
            latencies = _latencies(listener, policy, joints, run)
            print(f"Starting each node {STARTS} times ...", flush=True)
            starts = _starts(listener, policy, run)
        finally:
            listener.close()
    return {name: RosFigures(periods[name], latencies[name], cpu[name], starts[name]) for name in (_NODE, _BARE)}


def _periods(listener: _Listener, policy: Path, logs: Path) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    heard = {_NODE: listener.listen(TOPIC), _BARE: listener.listen("/bare_node/by_timer")}
    with ExitStack() as stack:
        nodes = {
            _BARE: NodeProcess(_BARE, logs / "bare"),
            _NODE: NodeProcess(_NODE, logs / "node", policy_path=policy, autostart=True, goal="[0.0, 0.4]"),
        }
        for node in [*nodes.values(), NodeProcess("physai.ros.virtual_robot", logs / "robot")]:
            stack.enter_context(node)
        _wait(listener, lambda: all(len(messages) > 100 for messages in heard.values()), nodes)
        before = {name: (len(heard[name]), cpu_seconds(node.pid)) for name, node in nodes.items()}
        started = time.monotonic()
        listener.spin(lambda: False, PERIOD_SECONDS)
        elapsed = time.monotonic() - started
        periods, cpu = {}, {}
        for name, node in nodes.items():
            first, seconds = before[name]
            periods[name] = np.diff([sent for _, sent in heard[name][first:]]) * 1e-9
            cpu[name] = (cpu_seconds(node.pid) - seconds) / elapsed
    return periods, cpu


def _latencies(listener: _Listener, policy: Path, joints: tuple[str, ...], logs: Path) -> dict[str, np.ndarray]:
    heard = {_NODE: listener.listen(TOPIC), _BARE: listener.listen("/bare_node/by_state")}
    message = JointState(name=list(joints), position=[0.3] * len(joints), velocity=[0.0] * len(joints))
    publisher = listener.node.create_publisher(JointState, "/joint_states", 1)
    sent: list[float] = []

    def send() -> None:
        message.header.stamp = listener.node.get_clock().now().to_msg()
        sent.append(time.monotonic())
        publisher.publish(message)

    with ExitStack() as stack:
        nodes = {
            _BARE: NodeProcess(_BARE, logs / "bare"),
            _NODE: NodeProcess(
                _NODE, logs / "node", policy_path=policy, autostart=True, trigger="joint_state", goal="[0.0, 0.4]"
            ),
        }
        for node in nodes.values():
            stack.enter_context(node)
        timer = listener.node.create_timer(1.0 / STATE_RATE, send)
        _wait(listener, lambda: all(len(messages) > 100 for messages in heard.values()), nodes)
        first = len(sent)
        listener.spin(lambda: False, LATENCY_SECONDS)
        listener.node.destroy_timer(timer)
        listener.node.destroy_publisher(publisher)
    moments = np.array(sent[first:])
    latencies = {}
    for name, messages in heard.items():
        arrivals = np.array([arrival for arrival, _ in messages])
        arrivals = arrivals[arrivals > moments[0]]
        latencies[name] = arrivals - moments[np.searchsorted(moments, arrivals) - 1]
    return latencies


def _starts(listener: _Listener, policy: Path, logs: Path) -> dict[str, np.ndarray]:
    heard = {
        _NODE: listener.listen("/inference_node/state", String, qos.LATCHED),
        _BARE: listener.listen("/bare_node/by_timer"),
    }
    parameters: dict[str, dict[str, Any]] = {_NODE: {"policy_path": policy}, _BARE: {}}
    seconds: dict[str, list[float]] = {name: [] for name in heard}
    for _ in range(STARTS):
        for name, messages in heard.items():
            messages.clear()
            started = time.monotonic()
            with NodeProcess(name, logs / "start", **parameters[name]) as node:
                _wait(listener, lambda messages=messages: messages, {name: node})  # type: ignore[misc]
                seconds[name].append(messages[0][0] - started)
            listener.spin(lambda: False, 0.5)
    return {name: np.array(values) for name, values in seconds.items()}


def _wait(listener: _Listener, ready: Callable[[], object], nodes: dict[str, NodeProcess]) -> None:
    if not listener.spin(lambda: ready() or any(node.ended for node in nodes.values()), _PATIENCE) or not ready():
        raise UserError("; ".join(f"{name}: {node.last_words()}" for name, node in nodes.items()))


def ros_table(figures: dict[str, RosFigures]) -> Table:
    """Show both nodes side by side."""
    shown = table("50 Hz over ROS 2", "", "inference node", "bare rclpy node")

    def row(label: str, show: Callable[[RosFigures], str]) -> None:
        shown.add_row(label, *(show(node) for node in figures.values()))

    for percent in (50, 99, 100):
        row(f"period, {_name(percent)}", lambda node, p=percent: f"{np.percentile(node.periods, p) * 1e3:.2f} ms")  # type: ignore[misc]
    for percent in (50, 99, 100):
        row(
            f"joint state to command, {_name(percent)}",
            lambda node, p=percent: f"{np.percentile(node.latencies, p) * 1e3:.2f} ms",  # type: ignore[misc]
        )
    row("load of a core", lambda node: f"{node.cpu:.1%}")
    row("start to first message, median", lambda node: f"{np.median(node.starts):.2f} s")
    row("start to first message, longest", lambda node: f"{node.starts.max():.2f} s")
    return shown


def _name(percent: int) -> str:
    return "longest" if percent == 100 else f"p{percent}"
