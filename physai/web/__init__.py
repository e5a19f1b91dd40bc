"""Robots in a browser, drawn by viser: it shows, and nothing that moves a robot is decided here."""

from physai.web.appearance import Appearance
from physai.web.goal import GoalMarker
from physai.web.scene import RobotScene
from physai.web.server import serve

__all__ = ["Appearance", "GoalMarker", "RobotScene", "serve"]
