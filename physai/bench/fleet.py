"""Eight virtual arms on this computer: how soon one message stops all of them, and how regularly they are driven."""

import os
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
from rich.table import Table
from std_msgs.msg import Bool, Float64MultiArray
from std_srvs.srv import Trigger

from physai.artifact import FILES
from physai.bench.policy import make_run
from physai.bench.timing import table
from physai.deploy import Metadata, State, read_metadata
from physai.errors import UserError
from physai.ros.driving.fleet_client import Arm, FleetClient
from physai.ros.driving.fleet_nodes import fleet_nodes
from physai.ros.topics.commands import controller_topic
from physai.ros.topics.emergency_stop import ALL

ARMS = 8
TRIALS = 100
DRIVE_SECONDS = 20.0
MOVING = 0.3  # s that all arms move before they are stopped
LIMIT = 0.05  # s
_PATIENCE, _AFTER, _AGAIN = 60.0, 0.3, 0.5  # s


@dataclass
class FleetFigures:
    """What was measured.

    Attributes:
        zeros: From the message to the first zeros at each robot, s, [trials, arms].
        periods: Between the commands of the inference nodes, by their own clock, s.
    """

    zeros: np.ndarray
    periods: np.ndarray


@dataclass
class _Heard:
    """Commands at one robot: ns since 1970 of their arrival (and sending), and whether they are zeros."""

    arrived: list[int] = field(default_factory=list)
    still: list[bool] = field(default_factory=list)
    sent: list[int] = field(default_factory=list)

    def take(self, message: Float64MultiArray, info: dict[str, int]) -> None:
        self.arrived.append(info["received_timestamp"])
        self.still.append(not any(message.data))

    def take_source(self, _: Float64MultiArray, info: dict[str, int]) -> None:
        self.sent.append(info["source_timestamp"])


class _Stopper(FleetClient):
    """A client that also stops and resets its arms, and hears what they are told."""

    def __init__(self, fleet: dict[str, Metadata], seed: int) -> None:
        super().__init__(fleet, seed, lambda name, arm: None)
        node = self._node
        self._stop = node.create_publisher(Bool, ALL, 10)
        self._resets = {name: node.create_client(Trigger, f"{name}/inference_node/reset") for name in fleet}
        self.heard = {name: _Heard() for name in fleet}
        for name, metadata in fleet.items():
            topic = f"{name}/{controller_topic(metadata.command.quantity)}"
            take: Any = self.heard[name].take
            node.create_subscription(Float64MultiArray, topic, take, 1000)
            take = self.heard[name].take_source
            node.create_subscription(Float64MultiArray, f"{name}/command_watchdog/commands", take, 1000)

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
            now = time.monotonic()
            for name, arm in self.arms.items():
                # Also out of a FAULT: on a busy computer a policy is too slow now and then.
                if arm.state in (State.ESTOP.value, State.FAULT.value) and now - asked[name] > _AGAIN:
                    self._resets[name].call_async(Trigger.Request())
                    asked[name] = now
                elif arm.state in (State.WAITING.value, State.REACHED.value) and now - arm.since > 0.1:
                    self._send(arm)
            if not all(map(_on_its_way, self.arms.values())) or any(heard.still[-1] for heard in self.heard.values()):
                since = now
            return now - since > MOVING

        self._wait(moving, "arms that move")

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
            print(f"Driving {ARMS} arms for {DRIVE_SECONDS:g} s ...", flush=True)
            client.drive(nodes, 0.5, 2.0)
            client.forget()
            client.drive(nodes, 0.5, DRIVE_SECONDS)
            periods = np.concatenate([np.diff(heard.sent) for heard in client.heard.values()]) * 1e-9
            print(f"Stopping all of them {TRIALS} times ...", flush=True)
            zeros = []
            for _ in range(TRIALS):
                client.start()
                client.forget()
                zeros.append(client.stop())
    return FleetFigures(np.array(zeros), periods)


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
        ("period of the commands", figures.periods),
    ):
        shown.add_row(name, *(f"{1e3 * value:.2f}" for value in (*np.quantile(values, [0.5, 0.99]), values.max())))
    return shown
