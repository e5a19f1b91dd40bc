"""``python -m physai.ros.demo``: an exported policy drives the virtual robot over ROS 2 (see ``--help``)."""

import os
import signal
import sys
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console

from physai import cli
from physai.compose import compose
from physai.config import Config, Count, PositiveFloat, Seed, validate
from physai.deploy import ControllerConfig, load_policy, read_metadata
from physai.deploy.limits import smallest_margin
from physai.errors import UserError
from physai.ros.driving.policies import newest_policies, robot_overrides


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
    from physai.plots.drive import draw_drive
    from physai.ros.driving.goal_client import GoalClient
    from physai.ros.driving.processes import NodeProcess

    config = validate(DemoConfig, node)
    path = config.path()
    policy = load_policy(path)
    console = Console()
    console.print(f"{path} drives a virtual {policy.metadata.robot} (randomization={config.robot})")
    with ExitStack() as stack:
        logs = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="physai-demo-")))
        client = stack.enter_context(closing(GoalClient(policy)))
        client.check_alone()
        env = policy.metadata.raw["config"]["env"]["name"]
        robot = NodeProcess(
            "physai.ros.virtual_robot",
            logs / "robot",
            env=env,
            overrides=robot_overrides(policy.metadata),
            randomization=config.robot,
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
        goals = policy.metadata.region.sample(config.goals, torch.Generator().manual_seed(config.seed))
        for number, goal in enumerate(goals, 1):
            result = client.send(goal, config.hold)
            console.print(f"  {number:>3}  {result.describe()}", highlight=False, soft_wrap=True)
    output = config.picture()
    try:
        draw_drive(client.record, policy, output)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot write {output}: {error}") from error
    kept = sum(result.kept for result in client.record.results)
    console.print(f"{kept} of {len(goals)} goals reached, and held for {config.hold:g} s. The path: {output}")
    if kept < len(goals):
        sys.exit(1)


if __name__ == "__main__":
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # as physai.ros wants it while a node is importing
        signal.signal(signal.SIGINT, signal.default_int_handler)
    cli.main("demo", _demo, _check)
