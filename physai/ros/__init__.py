"""ROS 2 around physai: nodes over :mod:`physai.deploy`, and robots behind topics as environments.

They need the ``ros`` extra, or a sourced ROS 2 Jazzy.
"""

import importlib
from typing import Any

from physai.errors import UserError

# Imported when they are asked for: the nodes need no gymnasium, and this package no ROS.
_HOMES = {"RosPhysics": "physai.ros.physics", "RosReacherEnv": "physai.ros.gym_env"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    try:
        import rclpy  # noqa: F401
    except ModuleNotFoundError:
        raise UserError("rclpy is not installed: pip install 'physai[ros]', or source ROS 2 Jazzy") from None
    return getattr(importlib.import_module(_HOMES[name]), name)
