"""``python -m physai.ros.demo``: an exported policy drives the virtual robot over ROS 2 (see ``--help``)."""

import os
import signal
import sys
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig
from rich.console import Console

from physai import cli
from physai.compose import compose
from physai.config import Config, Count, PositiveFloat, Seed, validate
from physai.deploy import ControllerConfig, load_policy, read_metadata
from physai.deploy.limits import smallest_margin
from physai.errors import UserError
from physai.ros.driving.policies import newest_policies, robot_engine, robot_overrides

if TYPE_CHECKING:
    from physai.ros.driving.client import Client


class DemoConfig(Config):
    """``conf/demo.yaml``."""

    policy_path: str | None
    goals: Count
    hold: PositiveFloat
    max_velocity: PositiveFloat
    randomization: dict[str, Any]
    seed: Seed
    output: str | None

    @property
    def robot(self) -> str:
        """File of ``conf/randomization`` that the robot is drawn from."""
        return str(self.randomization["name"])

    def path(self) -> Path:
        """The policy file.

        Raises:
            UserError: If there is none.
        """
        if self.policy_path is not None:
            return Path(self.policy_path)
        return newest_policies()[0]

    def picture(self) -> Path:
        """Where the picture goes."""
        return Path(self.output) if self.output else self.path().with_name("demo.png")


def _check(node: DictConfig) -> None:
    config = validate(DemoConfig, node)
    metadata = read_metadata(config.path())
    robot_overrides(metadata)
    if node.randomization != compose("train", [f"randomization={config.robot}"]).randomization:
        raise UserError("randomization: the virtual robot takes a file of conf/randomization as it is")
    picture = config.picture()
    if picture.suffix != ".png" or not os.access(picture.parent, os.W_OK):
        raise UserError(f"output: cannot write {picture}: a .png in a folder that exists is needed")
    if config.max_velocity > metadata.velocity_limit.min():
        raise UserError(f"max_velocity: the robot's limit is {metadata.velocity_limit.min():g} rad/s")


def _demo(node: DictConfig, _: Path) -> None:
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # no robot but ours shall hear of this
    from physai.ros.driving.goal_client import GoalClient
    from physai.ros.driving.processes import NodeProcess
    from physai.ros.driving.square_client import SquareClient

    config = validate(DemoConfig, node)
    path = config.path()
    policy = load_policy(path)
    console = Console()
    console.print(f"{path} drives a virtual {policy.metadata.robot} (randomization={config.robot})")
    with ExitStack() as stack:
        logs = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="physai-demo-")))
        kind = SquareClient if policy.metadata.floats else GoalClient
        client: Client = stack.enter_context(closing(kind(policy)))
        client.check_alone()
        env = policy.metadata.raw["config"]["env"]["name"]
        robot = NodeProcess(
            "physai.ros.virtual_robot",
            logs / "robot",
            env=env,
            overrides=robot_overrides(policy.metadata),
            randomization=config.robot,
            physics=robot_engine(policy.metadata),
            seed=config.seed,
        )
        period = 1.0 / policy.metadata.control_rate
        margin = smallest_margin(config.max_velocity, ControllerConfig.state_timeout, period)
        inference = NodeProcess(
            "physai.ros.inference_node",
            logs / "inference",
            policy_path=path,
            autostart=True,
            max_velocity=config.max_velocity,
            limit_margin=max(ControllerConfig.limit_margin, margin),
        )
        for process in (robot, inference):
            stack.enter_context(process)
        client.watch = (robot, inference)
        client.wait_until_ready()
        console.print("virtual_robot and inference_node work; sending goals")
        kept = []
        for number, (line, as_wanted) in enumerate(client.drive(config.goals, config.hold, config.seed), 1):
            console.print(f"  {number:>3}  {line}", highlight=False, soft_wrap=True)
            kept.append(as_wanted)
    output = config.picture()
    try:
        client.draw(output)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot write {output}: {error}") from error
    console.print(f"{sum(kept)} of {len(kept)} {client.done(config.hold)}. The path: {output}")
    if not all(kept):
        sys.exit(1)


if __name__ == "__main__":
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # as physai.ros wants it while a node is importing
        signal.signal(signal.SIGINT, signal.default_int_handler)
    cli.main("demo", _demo, _check)
