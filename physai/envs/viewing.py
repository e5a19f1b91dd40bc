"""Looking at simulated robots; nothing of a viewer is imported before somebody looks."""

import os
import sys
from typing import TYPE_CHECKING

import numpy as np
import torch

from physai.config import not_installed
from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.signals import Quantity

if TYPE_CHECKING:
    from physai.physics.following_viewer import FollowingViewer
    from physai.physics.stick_figure import StickFigure
    from physai.physics.viewer import Viewer

_SIZE = 0.03  # m; of the marker of a goal whose tolerance is no length


def has_screen() -> bool:
    """Whether a window can be opened here."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


def make_viewer(simulation: Simulation, window: bool = False) -> "Viewer | FollowingViewer | StickFigure":
    """Make a viewer for these robots; it has a world of its own. Without PyBullet it draws lines.

    Raises:
        UserError: If a window is asked for where there is no screen, or no PyBullet to open it; or a robot whose base
            floats is to be drawn without that.
    """
    if window and not has_screen():
        raise UserError("there is no screen here (DISPLAY is not set): render images instead of a window")
    if simulation.spec.floating is not None:
        try:
            from physai.physics.following_viewer import FollowingViewer
        except ModuleNotFoundError as error:
            raise UserError(f"to draw a robot on legs needs {not_installed('pybullet')}") from error
        return FollowingViewer(simulation.spec, window)
    tolerance, reach = simulation.task.tolerances[0], simulation.kinematics.reach
    size = tolerance.value if tolerance.unit == "m" else _SIZE
    try:
        from physai.physics.viewer import Viewer
    except ModuleNotFoundError as error:
        if window:
            raise UserError(f"a window needs {not_installed('pybullet')}: render images instead") from error
        from physai.physics.stick_figure import StickFigure

        return StickFigure(simulation.spec, reach, size)
    home = torch.from_numpy(simulation.spec.home).float()
    height = float(simulation.kinematics(home[None])[0, 2])
    return Viewer(simulation.spec, height, reach, size, window)


def show(viewer: "Viewer | FollowingViewer | StickFigure", simulation: Simulation, row: int = 0) -> np.ndarray | None:
    """Show a robot and its goal; return an image [height, width, 3] uint8, or None with a window."""
    goal, pose = simulation.goal[row], simulation.state.base_pose
    if pose is not None:
        return viewer.show(simulation.state.joint_position[row], pose[row])
    if simulation.task.goal.quantity is Quantity.JOINT_POSITION:  # where the end effector would be
        goal = simulation.kinematics(torch.from_numpy(goal[None]).float())[0].numpy()
    return viewer.show(simulation.state.joint_position[row], goal)
