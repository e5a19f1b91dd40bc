"""ROS 2 around physai: nodes over :mod:`physai.deploy`, and a robot behind topics as a physics.

They need the ``ros`` extra, or a sourced ROS 2 Jazzy.
"""

import importlib.util
import sys
from typing import Any

from physai.errors import UserError
from physai.ros.node import outlet, signals

_WITHOUT_ROS = "rclpy is not installed: pip install 'physai[ros]', or source ROS 2 Jazzy"

outlet.open_closed()
if sys.argv[:1] == ["-m"]:  # python -m physai.ros.<node>
    signals.end_quietly()
    if importlib.util.find_spec("rclpy") is None:
        print(f"error: {_WITHOUT_ROS}", file=sys.stderr)
        sys.exit(2)


def __getattr__(name: str) -> Any:
    if name != "RosPhysics":  # imported when it is asked for: this package needs no ROS
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    if importlib.util.find_spec("rclpy") is None:
        raise UserError(_WITHOUT_ROS)
    from physai.ros.bridge.physics import RosPhysics

    return RosPhysics
