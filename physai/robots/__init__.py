"""What a robot is: its URDF, its limits, its kinematics."""

from physai.robots.bodies import engine_urdf
from physai.robots.command import JointCommand
from physai.robots.ends import ends_at_home, kinematics_of
from physai.robots.floating import FloatingBase
from physai.robots.inverse import InverseKinematics
from physai.robots.kinematics import (
    EndEffector,
    ForwardKinematics,
    angle_between,
    quaternion_matrix,
    rotation_vector,
)
from physai.robots.mirror import Mirror
from physai.robots.spec import RobotConfig, RobotSpec

__all__ = [
    "EndEffector",
    "FloatingBase",
    "ForwardKinematics",
    "InverseKinematics",
    "JointCommand",
    "Mirror",
    "RobotConfig",
    "RobotSpec",
    "angle_between",
    "ends_at_home",
    "engine_urdf",
    "kinematics_of",
    "quaternion_matrix",
    "rotation_vector",
]
