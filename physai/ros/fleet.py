"""``python -m physai.ros.fleet``: many virtual robots, each with its policy and its watchdog (see ``--help``)."""

import importlib.util
import os
import re
import signal
import tempfile
import time
from contextlib import ExitStack, closing
from importlib import import_module
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from omegaconf import DictConfig
from rich.console import Console

from physai import cli
from physai.compose import compose
from physai.config import Config, Count, PageConfig, PositiveFloat, Seed, not_installed, validate
from physai.deploy import Metadata, State, read_metadata
from physai.errors import UserError
from physai.ros.driving.policies import newest_policies, robot_overrides

if TYPE_CHECKING:
    from physai.ros.driving.forked import ForkedProcess

_FOREVER = 1e9  # s
_PATIENCE = 60.0  # s, for the dashboard to start
_PER_CORE, _IN_TIME = 5, 16  # arms of two joints: with all their nodes; and whose inference nodes share one core
_MOST = 64  # arms, of which a page shows no more


class FleetConfig(Config):
    """``conf/fleet.yaml``."""

    policies: list[str]
    arms: Count
    max_velocity: PositiveFloat
    hold: PositiveFloat
    seconds: PositiveFloat | None
    randomization: dict[str, Any]
    seed: Seed
    render: Literal["web"] | None
    web: PageConfig

    @property
    def robot(self) -> str:
        """File of ``conf/randomization`` that the robots are drawn from."""
        return str(self.randomization["name"])

    def fleet(self) -> dict[str, tuple[Path, Metadata]]:
        """The policy in each namespace, in turns.

        Raises:
            UserError: If there is none, or a file is none.
        """
        if self.policies:
            found = [(Path(path), read_metadata(path)) for path in self.policies]
            for path, metadata in found:
                if metadata.floats:
                    raise UserError(f"{path}: a fleet is of arms, and '{metadata.robot}' is on legs")
        else:
            newest: dict[str, tuple[Path, Metadata]] = {}
            for path in newest_policies():
                metadata = read_metadata(path)
                newest.setdefault(metadata.robot, (path, metadata))
            found = [each for each in newest.values() if not each[1].floats]
            if not found:
                raise UserError("no policy.pt of an arm in outputs/: train one (python -m physai.train), or name one")
        return {f"/arm{number}": each for number, each in enumerate(islice(cycle(found), self.arms), 1)}


def _check(node: DictConfig) -> None:
    config = validate(FleetConfig, node)
    if config.arms > _MOST:
        raise UserError(f"arms: {_MOST} at most, got {config.arms}")
    if config.render == "web" and importlib.util.find_spec("viser") is None:
        raise UserError(f"render=web needs {not_installed('viser')}")
    if node.randomization != compose("train", [f"randomization={config.robot}"]).randomization:
        raise UserError("randomization: the virtual robots take a file of conf/randomization as it is")
    for path, metadata in config.fleet().values():
        robot_overrides(metadata)
        if config.max_velocity > metadata.velocity_limit.min():
            raise UserError(f"max_velocity: the limit of {path} is {metadata.velocity_limit.min():g} rad/s")


def _fleet(node: DictConfig, _: Path) -> None:
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # no robot but ours shall hear of this
    from physai.ros.driving.fleet_client import Arm, FleetClient
    from physai.ros.driving.forked import ForkedProcess, end, ros_arguments
    from physai.ros.fleet_nodes import fleet_nodes

    config = validate(FleetConfig, node)
    fleet = config.fleet()
    console = Console(highlight=False, soft_wrap=True)

    def tell(namespace: str, arm: Arm) -> None:
        if arm.state in (State.HOLD.value, State.FAULT.value, State.ESTOP.value):
            console.print(f"{namespace}: {arm.why}")

    with ExitStack() as stack:
        logs = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="physai-fleet-")))
        for namespace, (path, metadata) in fleet.items():
            console.print(f"{namespace}: {path} drives a virtual {metadata.robot}")
        cores = os.cpu_count() or 1
        if config.arms > (enough := min(_PER_CORE * cores, _IN_TIME)):
            console.print(
                f"{config.arms} arms are many for {cores} cores, and one that is late stops: try arms={enough}"
            )
        nodes = stack.enter_context(fleet_nodes(fleet, config.robot, config.max_velocity, config.seed, logs))
        page = None
        if config.render == "web":
            dashboard = import_module("physai.ros.dashboard").main  # needs viser
            page = ForkedProcess("page", logs / "page", dashboard, ros_arguments("/", **config.web.model_dump()))
            stack.callback(end, [page])
        client = FleetClient({name: metadata for name, (_, metadata) in fleet.items()}, config.seed, tell)
        stack.enter_context(closing(client))
        client.wait_until_ready(nodes)
        if page is not None:
            console.print(f"the page: {_address(page)}")
        console.print("all of them work; sending goals (Ctrl-C ends it)")
        try:
            client.drive(nodes, config.hold, config.seconds or _FOREVER)
        except KeyboardInterrupt:
            if config.seconds is not None:
                raise
        for namespace, arm in client.arms.items():
            console.print(f"{namespace}: {arm.reached} of {arm.sent} goals reached; {arm.state}")


def _address(page: "ForkedProcess") -> str:
    """Wait until the dashboard says where it is, and return that, or why it does not."""
    until = time.monotonic() + _PATIENCE
    while time.monotonic() < until:
        if page.log.exists() and (found := re.search(r"http://[^\s:]+:[0-9]+", page.log.read_text())):
            return found.group()
        if page.ended:  # the arms go on
            return f"it has ended: {page.last_words()}"
        time.sleep(0.05)
    return f"it has said nothing for {_PATIENCE:g} s"


if __name__ == "__main__":
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # as physai.ros wants it while a node is importing
        signal.signal(signal.SIGINT, signal.default_int_handler)
    cli.main("fleet", _fleet, _check)
