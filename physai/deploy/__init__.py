"""What a robot computer needs: a policy file, checked and loaded, and a controller that drives with it safely.

Importing it takes torch and numpy, and nothing else.
"""

from physai.deploy.command import Command, State
from physai.deploy.controller import Controller
from physai.deploy.goals import Goal
from physai.deploy.imu import Imu
from physai.deploy.joints import JointState
from physai.deploy.legged import LeggedController, make_controller
from physai.deploy.metadata import Metadata
from physai.deploy.parameters import ControllerConfig
from physai.deploy.policy import Driver, Policy, load_policy, read_metadata
from physai.deploy.reading import PolicyError

__all__ = [
    "Command",
    "Controller",
    "ControllerConfig",
    "Driver",
    "Goal",
    "Imu",
    "JointState",
    "LeggedController",
    "Metadata",
    "Policy",
    "PolicyError",
    "State",
    "load_policy",
    "make_controller",
    "read_metadata",
]
