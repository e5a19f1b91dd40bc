"""What a robot is: its URDF, its limits, its kinematics."""

from physai.robots.bodies import engine_urdf
from physai.robots.command import JointCommand
from physai.robots.feet import feet, feet_at_home
from physai.robots.floating import FloatingBase
from physai.robots.inverse import InverseKinematics
from physai.robots.kinematics import (
    EndEffector,
    ForwardKinematics,
    angle_between,
    quaternion_matrix,
    rotation_vector,
)
from physai.robots.spec import RobotConfig, RobotSpec

__all__ = [
    "EndEffector",
    "FloatingBase",
    "ForwardKinematics",
    "InverseKinematics",
    "JointCommand",
    "RobotConfig",
    "RobotSpec",
    "angle_between",
    "engine_urdf",
    "feet",
    "feet_at_home",
    "quaternion_matrix",
    "rotation_vector",
]
