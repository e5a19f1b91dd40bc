"""A robot as lines from joint to joint, drawn by Matplotlib: what there is to look at where PyBullet is missing."""

from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from physai.robots import RobotSpec, urdf

_DOTS = 75  # per inch


class StickFigure:
    """Shows one robot with its goal as images; it has the methods of :class:`physai.physics.viewer.Viewer`.

    Args:
        spec: The robot.
        reach: Length of the arm, m; sets what is in the picture.
        tolerance: Radius of the goal's marker, m.
        width: Of an image, pixels.
        height: Of an image, pixels.
    """

    def __init__(self, spec: RobotSpec, reach: float, tolerance: float, width: int = 480, height: int = 360) -> None:
        self._spec = spec
        figure = Figure(figsize=(width / _DOTS, height / _DOTS), dpi=_DOTS)
        self._canvas = FigureCanvasAgg(figure)
        axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d", proj_type="persp")
        self._height = float(self.points(spec.home)[-1, 2])
        top = 1.1 * max(self._height, 0.2 * reach)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(0.0, top))
        axes.set_box_aspect((2.0 * reach, 2.0 * reach, top), zoom=1.1)
        axes.tick_params(labelcolor="none")
        axes.view_init(elev=35, azim=-50)
        (self._arm,) = axes.plot([], [], [], "o-", color="#34495e", linewidth=5, markersize=7, solid_capstyle="round")
        diameter = 2.0 * tolerance / (2.0 * reach) * 0.6 * width  # pixels, about
        green = {"color": "#1abf52", "alpha": 0.8}
        (self._goal,) = axes.plot([], [], [], "o", **green, markersize=72 * diameter / _DOTS)
        (self._pole,) = axes.plot([], [], [], "--", **green)  # above a goal in the plane, as high as the tip at home

    def points(self, joint_position: np.ndarray) -> np.ndarray:
        """Return where the arm bends in a pose [n], rad, from base to end effector, m, [points, 3]."""
        position, frame = dict(zip(self._spec.joints, joint_position, strict=True)), np.eye(4)
        points = [frame[:3, 3]]
        for joint in self._spec.linkage:
            frame = frame @ urdf.transform(joint.origin)
            points.append(frame[:3, 3])
            if joint.name in position:
                axis = np.array(joint.axis or [1.0, 0.0, 0.0])  # what a URDF means that names none
                turned = np.eye(4)
                turned[:3, :3] = Rotation.from_rotvec(position[joint.name] * axis / np.linalg.norm(axis)).as_matrix()
                frame = frame @ turned
        return np.array(points)

    def show(self, joint_position: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Show a pose [n], rad, and a goal, its position first [2, 3 or 7], m; return [height, width, 3] uint8."""
        self._arm.set_data_3d(*self.points(joint_position).T)
        x, y, z = [*goal.tolist(), 0.0][:3]
        self._goal.set_data_3d([x], [y], [z])
        self._pole.set_data_3d([x, x], [y, y], [z, self._height if len(goal) == 2 else z])
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Do nothing: all of it goes with this object."""
