"""One robot in the scene: its arm, its goal, the path of its tip, and its state as a colour."""

from collections import deque

import numpy as np
import viser

from physai.deploy.metadata import read_goal
from physai.errors import UserError
from physai.ros.live.status import Level, Status
from physai.web import GoalMarker, RobotScene
from physai.web.described import Described
from physai.web.goal import OnDrag

_PATH = 200  # points
_STEP = 0.005  # m from point to point
_PENDING = 2.0  # s that a goal which was sent is shown, until the robot has told of it
_VIOLET = (120, 60, 200)


class ArmView:
    """Draws a robot from its descriptions.

    Args:
        server: Where to draw it.
        status: Which one.
        on_drag: As a :class:`physai.web.GoalMarker` takes it; None: its goal cannot be dragged.

    Attributes:
        reach: Length of the stretched robot, m.
        distance: From its tip to its goal, m; NaN while one of them is not known.

    Raises:
        UserError: If its description cannot be drawn.
    """

    def __init__(self, server: viser.ViserServer, status: Status, on_drag: OnDrag | None) -> None:
        self._described = described = Described.read(status.description)
        self.descriptions = status.description, status.goal_description
        look = described.appearance
        self.reach, self.distance = look.reach, float("nan")
        self._server = server
        self._scene = RobotScene(server, f"robot_{status.name.replace('/', '_')}", look)
        self._path: deque[np.ndarray] = deque(maxlen=_PATH)
        self._drawn_path = 0
        self._position = np.full(look.joints, np.nan)
        self._marker: GoalMarker | None = None
        self.problem = "" if status.goal_description else "it has not said what its goals are"
        root, scene = self._scene.root, server.scene
        if status.goal_description:
            try:
                goal, region, tolerances = read_goal(status.goal_description)
            except UserError as error:
                self.problem = str(error)
            else:
                self._size = goal.size
                self._marker = GoalMarker(self._scene, server, goal, tolerances, region, np.zeros(look.joints), on_drag)
                if not self._marker.drawable:
                    self.problem = f"its goals are {goal.quantity.value}s, which cannot be dragged"
        self._plate = scene.add_cylinder(
            f"{root}/plate", 0.16 * look.reach, 0.01, Level.GONE.value, position=(0.0, 0.0, look.floor - 0.006)
        )
        self._label = scene.add_label(
            f"{root}/label", status.name, position=(0.0, 0.0, look.floor - 0.02), anchor="top-center"
        )
        self._line = scene.add_line_segments(
            f"{root}/path", np.zeros((0, 2, 3), np.float32), _VIOLET, thickness=2.0, thickness_units="screen"
        )

    def place(self, position: tuple[float, float, float]) -> None:
        """Put it elsewhere, m."""
        self._scene.place(position)

    def show(self, status: Status, level: Level, dragged: bool, now: float) -> None:
        """Show what is known.

        Args:
            status: Of the robot.
            level: How urgent it is.
            dragged: Whether somebody drags its goal: then the browser knows better where it is.
            now: The time, s.
        """
        joints = status.joint_position
        known = all(joint in joints for joint in self._described.joints)
        if known:
            position = np.array([joints[joint] for joint in self._described.joints])
            if np.isfinite(position).all():
                self._position = position
                self._scene.show(position)
        if status.turn is not None:
            self._scene.turn_base(status.turn, self._described.height)
        self._color(level)
        tip = self._described.appearance.tip_position(self._position) if np.isfinite(self._position).all() else None
        if tip is not None and (not self._path or np.linalg.norm(tip - self._path[-1]) > _STEP):
            self._path.append(tip)
            self._drawn_path += 1
        goal = self._goal(status, now)
        self.distance = float("nan")
        if tip is not None and goal is not None and self._marker is not None and self._marker.drawable:
            size = min(self._size, 3)
            self.distance = float(np.linalg.norm(tip[:size] - goal[:size]))
        if self._marker is not None and not dragged:
            self._marker.show(goal if goal is not None else self._at_tip(tip))

    def show_path(self) -> None:
        """Draw where its tip has been, if it has moved."""
        if self._drawn_path and len(self._path) > 1:
            points = np.array(self._path, np.float32)
            self._line.points = np.stack([points[:-1], points[1:]], axis=1)
            self._drawn_path = 0

    def _color(self, level: Level) -> None:
        if tuple(self._plate.color) != level.value:
            self._plate.color = level.value

    def _goal(self, status: Status, now: float) -> np.ndarray | None:
        goal = status.goal
        if status.goal_sent is not None and now - status.goal_sent[1] < _PENDING:
            goal = status.goal_sent[0]
        if goal is None or self._marker is None or goal.size != self._size:
            return None
        return goal

    def _at_tip(self, tip: np.ndarray | None) -> np.ndarray | None:
        """Where the marker waits to be dragged while there is no goal."""
        if tip is None or self._marker is None or self._size not in (2, 3, 7):
            return None
        return tip[: self._size] if self._size < 7 else np.array([*tip, 0.0, 0.0, 0.0, 1.0])

    def fastest(self, before: np.ndarray | None, elapsed: float) -> float:
        """How fast the fastest joint was since it was elsewhere, rad/s; NaN where that is not known."""
        if before is None or elapsed <= 0 or not np.isfinite(before).all():
            return float("nan")
        return float(np.abs(self._position - before).max() / elapsed)

    @property
    def position(self) -> np.ndarray:
        """Where its joints are, rad; NaN until they have told."""
        return self._position

    def remove(self) -> None:
        """Take it out of the scene."""
        self._scene.remove()
