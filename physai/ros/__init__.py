"""ROS 2 around physai: nodes over :mod:`physai.deploy`, and robots behind topics as environments.

They need the ``ros`` extra, or a sourced ROS 2 Jazzy.
"""

import importlib
import importlib.util
import sys
from typing import Any

from physai.errors import UserError
from physai.ros.node import outlet, signals

# Imported when they are asked for: the nodes need no gymnasium, and this package no ROS.
_HOMES = {"RosPhysics": "physai.ros.bridge.physics", "RosReacherEnv": "physai.ros.bridge.gym_env"}


_WITHOUT_ROS = "rclpy is not installed: pip install 'physai[ros]', or source ROS 2 Jazzy"

outlet.open_closed()
if sys.argv[:1] == ["-m"]:  # python -m physai.ros.<node>
    signals.end_quietly()
if sys.argv[:1] == ["-m"] and importlib.util.find_spec("rclpy") is None:
    print(f"error: {_WITHOUT_ROS}", file=sys.stderr)
    sys.exit(2)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    try:
        import rclpy  # noqa: F401
    except ModuleNotFoundError as error:
        raise UserError(_WITHOUT_ROS) from error
    return getattr(importlib.import_module(_HOMES[name]), name)
