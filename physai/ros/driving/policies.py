"""Which policies a demo takes, and the virtual robot that each was trained for."""

import json
from pathlib import Path
from typing import Any

from physai.compose import conf_dir
from physai.deploy import Metadata
from physai.errors import UserError


def newest_policies() -> list[Path]:
    """Return the policy files of ``outputs/``, the newest one first.

    Raises:
        UserError: If there is none.
    """
    found = sorted(Path("outputs").glob("**/policy.pt"), key=lambda path: path.stat().st_mtime, reverse=True)
    if not found:
        raise UserError("no policy.pt in outputs/: train one (python -m physai.train), or name one")
    return found


def robot_engine(metadata: Metadata) -> str:
    """Which file of ``conf/physics`` simulates the robot: legs walk in the engine that they were trained in."""
    engine = metadata.raw["config"]["env"]["physics"]["_target_"]
    return "mujoco" if metadata.floats and engine.endswith("MuJoCoPhysics") else "pybullet"


def robot_overrides(metadata: Metadata) -> list[str]:
    """What makes the virtual robot the one that the policy was trained on: Hydra overrides of its env.

    Raises:
        UserError: If ``conf/robot`` has no such robot: a URDF that a policy file names is not read.
    """
    robot = metadata.raw["config"]["env"]["robot"]
    files = [path.stem for path in (conf_dir() / "robot").glob("*.yaml")]
    if metadata.robot not in files:
        raise UserError(f"the policy is for '{metadata.robot}', and conf/robot has only {', '.join(sorted(files))}")
    changed = ["joints", "home", "command_limit"]
    if metadata.floats:
        changed += ["servo.stiffness", "servo.damping", "floating.height", "floating.friction"]
    else:
        changed += ["end_effector", "command", "position_gain", "gravity"]
    return [
        f"robot@env.robot={metadata.robot}",
        *(f"env.robot.{key}={json.dumps(_value(robot, key))}" for key in changed),
        "env.start.spread=0.0",
    ]


def _value(robot: Any, key: str) -> Any:
    for part in key.split("."):
        robot = robot[part]
    return robot
