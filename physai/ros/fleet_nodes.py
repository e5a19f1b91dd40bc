"""The nodes of a fleet of virtual robots: each robot, its watchdog and its inference node, in a namespace."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from physai.deploy import ControllerConfig, Metadata
from physai.deploy.limits import smallest_margin
from physai.ros.command_watchdog import CommandWatchdog
from physai.ros.driving.forked import ForkedProcess, end, ros_arguments
from physai.ros.driving.policies import robot_overrides
from physai.ros.inference_node import InferenceNode
from physai.ros.node.run import run_together
from physai.ros.virtual_robot import VirtualRobot


@contextmanager
def fleet_nodes(
    fleet: Mapping[str, tuple[Path, Metadata]], randomization: str, max_velocity: float, seed: int, logs: Path
) -> Iterator[list[ForkedProcess]]:
    """Context in which they run; this process must not have started ROS yet.

    There are three processes: of the robots, of their watchdogs, and of who drives.

    Args:
        fleet: The policy file in each namespace, and what it says of itself.
        randomization: File of ``conf/randomization`` that each robot is drawn from.
        max_velocity: Of the fastest joint, rad/s.
        seed: Of the first robot; the others count on.
        logs: Folder for their output.
    """
    robots, watchdogs, drivers = {}, {}, {}
    for number, (namespace, (path, metadata)) in enumerate(fleet.items()):
        drawn = {"randomization": randomization, "seed": seed + number}
        robots[namespace] = partial(VirtualRobot, ros_arguments(namespace, **_robot(metadata), **drawn))
        watchdogs[namespace] = partial(CommandWatchdog, ros_arguments(namespace, **_watchdog(metadata)))
        told = ros_arguments(namespace, policy_path=path, **_driver(metadata, max_velocity))
        drivers[namespace] = partial(InferenceNode, arguments=told)
    processes: list[ForkedProcess] = []
    with ExitStack() as stack:
        for name, nodes in (("virtual robots", robots), ("watchdogs", watchdogs), ("inference nodes", drivers)):
            processes.append(ForkedProcess(name, logs / name, partial(run_together, nodes)))
            stack.callback(end, processes[-1:])  # who drives ends first, and the robots last
        yield processes


def _robot(metadata: Metadata) -> dict[str, object]:
    return {
        "env": metadata.raw["config"]["env"]["name"],
        "overrides": robot_overrides(metadata),
        "rate_hz": metadata.control_rate,
    }


def _watchdog(metadata: Metadata) -> dict[str, object]:
    return {"joints": len(metadata.joints), "command": metadata.command.quantity.value}


def _driver(metadata: Metadata, max_velocity: float) -> dict[str, object]:
    margin = smallest_margin(max_velocity, ControllerConfig.state_timeout, 1.0 / metadata.control_rate)
    return {
        "autostart": True,
        "watchdog": "command_watchdog",
        "max_velocity": max_velocity,
        "limit_margin": max(ControllerConfig.limit_margin, margin),
    }
