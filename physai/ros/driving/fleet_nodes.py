"""The nodes of a fleet of virtual robots: each robot, its watchdog and its inference node, in a namespace."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path

from physai.deploy import ControllerConfig, Metadata
from physai.deploy.limits import smallest_margin
from physai.ros.driving.forked import ForkedNode, end
from physai.ros.driving.policies import robot_overrides

ROBOT, WATCHDOG, DRIVER = (f"physai.ros.{node}" for node in ("virtual_robot", "command_watchdog", "inference_node"))


@contextmanager
def fleet_nodes(
    fleet: Mapping[str, tuple[Path, Metadata]], randomization: str, max_velocity: float, seed: int, logs: Path
) -> Iterator[list[ForkedNode]]:
    """Context in which they run; this process must not have started ROS yet.

    Args:
        fleet: The policy file in each namespace, and what it says of itself.
        randomization: File of ``conf/randomization`` that each robot is drawn from.
        max_velocity: Of the fastest joint, rad/s.
        seed: Of the first robot; the others count on.
        logs: Folder for their output.
    """
    for module in (ROBOT, WATCHDOG, DRIVER):  # once for all of them
        import_module(module)
    nodes: dict[str, list[ForkedNode]] = {DRIVER: [], WATCHDOG: [], ROBOT: []}
    with ExitStack() as stack:
        for group in reversed(nodes.values()):  # who drives ends first, and the robots last
            stack.callback(end, group)
        for number, (namespace, (path, metadata)) in enumerate(fleet.items()):
            log = logs / namespace[1:]
            log.mkdir()
            for module, parameters in _parameters(metadata, max_velocity).items():
                if module == ROBOT:
                    parameters |= {"randomization": randomization, "seed": seed + number}
                elif module == DRIVER:
                    parameters |= {"policy_path": path}
                node = ForkedNode(module, log / module.rpartition(".")[2], namespace, **parameters)
                nodes[module].append(node)
        yield [node for group in nodes.values() for node in group]


def _parameters(metadata: Metadata, max_velocity: float) -> dict[str, dict[str, object]]:
    """What the nodes of one arm are told, by module."""
    margin = smallest_margin(max_velocity, ControllerConfig.state_timeout, 1.0 / metadata.control_rate)
    return {
        ROBOT: {
            "env": metadata.raw["config"]["env"]["name"],
            "overrides": robot_overrides(metadata),
            "rate_hz": metadata.control_rate,
        },
        WATCHDOG: {"joints": len(metadata.joints), "command": metadata.command.quantity.value},
        DRIVER: {
            "autostart": True,
            "watchdog": "command_watchdog",
            "max_velocity": max_velocity,
            "limit_margin": max(ControllerConfig.limit_margin, margin),
        },
    }
