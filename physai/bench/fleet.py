"""Eight virtual arms on this computer, and the page that shows them.

How regularly they are driven with the page and without, how old is what it shows, and how soon one message stops all.
"""

import os
import re
import tempfile
import time
from argparse import Namespace
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.subscription import Subscription
from rich.table import Table
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray
from std_srvs.srv import Trigger

from physai.artifact import FILES
from physai.bench.onlooker import Onlooker, ages
from physai.bench.policy import make_run
from physai.bench.timing import cpu_seconds, table
from physai.deploy import Metadata, State, read_metadata
from physai.errors import UserError
from physai.ros.driving.fleet_client import Arm, FleetClient
from physai.ros.driving.forked import ForkedProcess
from physai.ros.driving.processes import NodeProcess
from physai.ros.fleet_nodes import fleet_nodes
from physai.ros.topics import joint_states, qos
from physai.ros.topics.commands import controller_topic
from physai.ros.topics.emergency_stop import ALL
from physai.ros.topics.unawaited import Unawaited, nobody, waiting

ARMS = 8
TRIALS = 100
DRIVE_SECONDS = 20.0
MOVING = 0.3  # s that all arms move before they are stopped
LIMIT = 0.05  # s
_PAGE = "physai.ros.dashboard"
_GRID, _SETTLED = 10_000_000, 1_000_000_000  # ns between two looks at the page, and before the first
_PATIENCE, _AFTER, _AGAIN = 60.0, 0.3, 0.5  # s


@dataclass
class FleetFigures:
    """What was measured.

    Attributes:
        zeros: From the message to the first zeros at each robot, s, [trials, arms].
        periods: Between the commands of the inference nodes, by their own clock, s: while nobody listens, and beside
            the dashboard, which somebody looks at.
        ages: Of the joint states that the page shows, from when the robot sent them, every 10 ms, s.
        cpu: Share of a core, of each process.
    """

    zeros: np.ndarray
    periods: tuple[np.ndarray, np.ndarray]
    ages: np.ndarray
    cpu: dict[str, float]


@dataclass
class _Heard:
    """Commands at one robot: ns since 1970 of their arrival (and sending), and whether they are zeros."""

    arrived: list[int] = field(default_factory=list)
    still: list[bool] = field(default_factory=list)
    sent: list[int] = field(default_factory=list)

    @property
    def stands(self) -> bool:
        """Whether the last command does not move it, or none has come."""
        return not self.still or self.still[-1]

    def take(self, at_robot: Subscription, by_driver: Subscription) -> None:
        """Take what has come since the last time."""
        for message, info in waiting(at_robot):
            self.arrived.append(info["received_timestamp"])
            self.still.append(not any(message.data))
        self.sent += [info["source_timestamp"] for _, info in waiting(by_driver)]


class _Stopper(FleetClient):
    """A client that also stops and resets its arms, and hears what they are told; no command wakes it."""

    def __init__(self, fleet: dict[str, Metadata], seed: int) -> None:
        super().__init__(fleet, seed, lambda name, arm: None)
        node = self._node
        self._stop = node.create_publisher(Bool, ALL, 10, event_callbacks=qos.SILENT_PUBLISHER)
        self._resets = {name: node.create_client(Trigger, f"{name}/inference_node/reset") for name in fleet}
        self._told: dict[str, Subscription] = {}
        self._heard = {name: _Heard() for name in fleet}
        self._commands = {
            name: (
                self._keep(Float64MultiArray, f"{name}/{controller_topic(metadata.command.quantity)}"),
                self._keep(Float64MultiArray, f"{name}/command_watchdog/commands"),
            )
            for name, metadata in fleet.items()
        }

    def _keep(self, kind: type, topic: str) -> Subscription:
        return self._node.create_subscription(kind, topic, nobody, 100_000, callback_group=Unawaited())

    @property
    def heard(self) -> dict[str, _Heard]:
        """Commands until now."""
        for name, heard in self._heard.items():
            heard.take(*self._commands[name])
        return self._heard

    def listen(self) -> None:
        """Have the joint states kept from now on."""
        self._told = {name: self._keep(JointState, f"{name}/{joint_states.TOPIC}") for name in self.arms}

    def told(self) -> dict[str, np.ndarray]:
        """Return when each arm sent where its first joint is, ns since 1970 and rad, [n, 2]."""
        return {
            name: np.array([(info["source_timestamp"], message.position[0]) for message, info in waiting(told)])
            for name, told in self._told.items()
        }

    def stop(self) -> np.ndarray:
        """Stop all, and return when zeros came to each robot, s later; NaN where none did."""
        began = time.time_ns()
        self._stop.publish(Bool(data=True))
        self._spin(partial(self._all, State.ESTOP), _AFTER)
        self._spin(lambda: False, _AFTER)
        return np.array([self._zeros(heard, began) for heard in self.heard.values()])

    def _zeros(self, heard: _Heard, began: int) -> float:
        found = (at for at, still in zip(heard.arrived, heard.still, strict=True) if at >= began and still)
        return 1e-9 * (next(found, np.nan) - began)

    def _all(self, state: State) -> bool:
        return all(arm.state == state.value for arm in self.arms.values())

    def start(self) -> None:
        """Leave the stop, and have all arms on their way to goals.

        Raises:
            UserError: If they do not get there.
        """
        since = time.monotonic()
        asked = dict.fromkeys(self.arms, 0.0)

        def moving() -> bool:
            nonlocal since
            now, heard = time.monotonic(), self.heard
            for name, arm in self.arms.items():
                # Also out of a FAULT: on a busy computer a policy is too slow now and then.
                if arm.state in (State.ESTOP.value, State.FAULT.value) and now - asked[name] > _AGAIN:
                    self._resets[name].call_async(Trigger.Request())
                    asked[name] = now
                elif heard[name].stands and now - arm.since > _AGAIN:  # also where a joint is at its limit
                    self._send(arm)
            if not all(map(_on_its_way, self.arms.values())) or any(each.stands for each in heard.values()):
                since = now
            return now - since > MOVING

        self._wait(moving, "arms that move")

    def periods(self, nodes: list[ForkedProcess]) -> np.ndarray:
        """Drive for a while, and return what passed between two commands of each inference node, s."""
        self.drive(nodes, 0.5, 2.0)
        self.forget()
        self.drive(nodes, 0.5, DRIVE_SECONDS)
        return np.concatenate([np.diff(heard.sent) for heard in self.heard.values()]) * 1e-9

    def _wait(self, done: Any, what: str) -> None:
        if not self._spin(done, _PATIENCE):
            told = ", ".join(f"{name}: {arm.why}" for name, arm in self.arms.items())
            raise UserError(f"waited {_PATIENCE:g} s for {what}: {told}")

    def forget(self) -> None:
        """Go on with empty lists, but for the last commands."""
        for heard in self.heard.values():
            heard.arrived, heard.still, heard.sent = heard.arrived[-1:], heard.still[-1:], []


def _on_its_way(arm: Arm) -> bool:
    return arm.state == State.ACTIVE.value


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return fleet_table(measure_fleet(options.seed))


def measure_fleet(seed: int) -> FleetFigures:
    """Drive eight arms, and stop them, again and again.

    Raises:
        UserError: If they cannot be driven.
    """
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # no robot shall hear of this
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / FILES["torchscript"]
        # In a process of its own: what is forked from one that has trained must not compute with threads.
        training = get_context("spawn").Process(target=make_run, args=(Path(folder), seed, ["torchscript"]))
        training.start()
        training.join()
        metadata = read_metadata(path)
        fleet = {f"/arm{number}": (path, metadata) for number in range(1, ARMS + 1)}
        with (
            fleet_nodes(fleet, "none", 0.3, seed, Path(folder)) as nodes,
            closing(_Stopper(dict.fromkeys(fleet, metadata), seed)) as client,
        ):
            client.wait_until_ready(nodes)
            print(f"Driving {ARMS} arms for {DRIVE_SECONDS:g} s, twice ...", flush=True)
            alone = client.periods(nodes)
            with NodeProcess(_PAGE, Path(folder) / "page", port=0) as page:
                host, port = _address(client, page, nodes)
                with closing(Onlooker(host, port)) as onlooker:
                    client.listen()
                    before, since = _cpu_seconds(nodes, page), time.monotonic()
                    watched = client.periods(nodes)
                    elapsed, after = time.monotonic() - since, _cpu_seconds(nodes, page)
                    told = client.told()
                    old = [_ages(onlooker.shown(name[1:]), told[name]) for name in fleet]
                print(f"Stopping all of them {TRIALS} times ...", flush=True)
                zeros = []
                try:
                    for _ in range(TRIALS):
                        client.start()
                        client.forget()
                        zeros.append(client.stop())
                except UserError as error:  # on a busy computer; what was measured until then counts
                    if not zeros:
                        raise
                    print(f"Stopped them {len(zeros)} times, and no more: {error}", flush=True)
    cpu = {kind: (after[kind] - seconds) / elapsed for kind, seconds in before.items()}
    return FleetFigures(np.array(zeros), (alone, watched), np.concatenate(old), cpu)


def _address(client: _Stopper, page: NodeProcess, nodes: list[ForkedProcess]) -> tuple[str, int]:
    until = time.monotonic() + 2 * _PATIENCE  # it gives way to all others
    while not (found := re.search(r"http://([^\s:]+):([0-9]+)", page.log.read_text())):
        if page.ended or time.monotonic() > until:
            raise UserError(f"no dashboard: {page.last_words()}")
        client.drive(nodes, 0.5, 0.5)
    return found[1], int(found[2])


def _ages(shown: np.ndarray, told: np.ndarray) -> np.ndarray:
    return ages(shown, told, range(int(told[0, 0]) + _SETTLED, int(told[-1, 0]), _GRID))


def _cpu_seconds(nodes: list[ForkedProcess], page: NodeProcess) -> dict[str, float]:
    """By whose they are."""
    seconds = {node.name: cpu_seconds(node.pid) for node in nodes}
    return seconds | {"page": cpu_seconds(page.pid), "this benchmark": time.process_time()}


def fleet_table(figures: FleetFigures) -> Table:
    """Show the figures."""
    late = int((~(figures.zeros.max(axis=1) <= LIMIT)).sum())
    trials, arms = figures.zeros.shape
    title = f"{arms} virtual arms; stopped {trials} times, {late} times not all of them within {LIMIT * 1e3:g} ms"
    shown = table(title, "", "p50, ms", "p99, ms", "longest, ms")
    last = figures.zeros.max(axis=1)
    for name, values in (
        (f"{ALL} to zeros at a robot", figures.zeros),
        (f"{ALL} to zeros at the last robot", last),
        ("period of the commands", figures.periods[0]),
        ("the same, with the dashboard", figures.periods[1]),
        ("age of joint states on its page", figures.ages),
    ):
        shown.add_row(name, *(f"{1e3 * value:.2f}" for value in (*np.quantile(values, [0.5, 0.99]), values.max())))
    shown.caption = "share of a core: " + ", ".join(f"{kind} {share:.0%}" for kind, share in figures.cpu.items())
    return shown
