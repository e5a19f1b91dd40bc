"""What a robot is: its URDF, its limits, its kinematics."""

from physai.robots.kinematics import ForwardKinematics, TipPosition
from physai.robots.spec import RobotConfig, RobotSpec

__all__ = ["ForwardKinematics", "RobotConfig", "RobotSpec", "TipPosition"]
