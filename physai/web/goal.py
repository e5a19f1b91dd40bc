"""A goal in a viser scene: where it is, how near is near enough, and where goals lie."""

from collections.abc import Callable

import numpy as np
import trimesh
import viser
from viser import TransformControlsEvent

from physai.signals import Ball, Box, Quantity, Reachable, Region, Ring, Signal, Tolerance
from physai.web.scene import RobotScene

_GREEN, _BLUE = (30, 180, 80), (70, 120, 220)
_SMALLEST = 0.01  # m; of the marker of a goal whose tolerance is no length, or a tiny one

OnDrag = Callable[[np.ndarray, bool], None]


class GoalMarker:
    """Draws a robot's goal, which can be dragged if somebody listens; dragging alone changes nothing else.

    Goals in the plane are drawn as high as the robot's end effector is at home.

    Args:
        robot: Whose goal it is: it is drawn in the frame of its base.
        server: Where to draw it.
        goal: What is asked of the robot: a position of two or three numbers, or a pose.
        tolerances: How near is near enough.
        region: Where goals lie; it is drawn faintly. None draws nothing.
        home: The robot's rest pose, rad, [n].
        on_drag: Called with the goal [g] and whether it was let go, while a browser drags it, in the order in which
            it happens; on the server's own thread, so it must return at once. None: it cannot be dragged.

    Attributes:
        drawable: Whether the goal is a place: nothing is drawn of others, such as joint positions.
    """

    def __init__(
        self,
        robot: RobotScene,
        server: viser.ViserServer,
        goal: Signal,
        tolerances: tuple[Tolerance, ...],
        region: Region | None,
        home: np.ndarray,
        on_drag: OnDrag | None = None,
    ) -> None:
        self.drawable = goal.quantity in (Quantity.POSITION, Quantity.POSE) and goal.size in (2, 3, 7)
        self._size, self._server, self._on_drag = goal.size, server, on_drag
        self._shown: np.ndarray | None = None
        if not self.drawable:
            return
        tip = robot.appearance.tip_position(home)
        self._height = 0.0 if tip is None or goal.size > 2 else float(tip[2])
        radius = max([each.value for each in tolerances if each.unit == "m"], default=_SMALLEST)
        name, reach = f"{robot.root}/goal", robot.appearance.reach
        if region is not None:
            _draw_region(server, f"{robot.root}/region", region, goal.size, self._height)
        turns, flat = goal.size == 7, goal.size == 2
        scene = server.scene
        self._handle: viser.TransformControlsHandle | viser.FrameHandle
        if on_drag is None:
            self._handle = scene.add_frame(name, show_axes=turns, axes_length=0.12 * reach, axes_radius=0.006 * reach)
        else:
            self._handle = scene.add_transform_controls(
                name,
                scale=0.25 * reach,
                active_axes=(True, True, not flat),
                disable_rotations=not turns,
                depth_test=False,
            )
            self._handle.on_update(self._dragged)
            if turns:
                scene.add_frame(f"{name}/axes", axes_length=0.12 * reach, axes_radius=0.006 * reach)
        scene.add_icosphere(f"{name}/ball", max(radius, _SMALLEST), color=_GREEN, opacity=0.6, cast_shadow=False)
        self._handle.visible = False

    def show(self, goal: np.ndarray | None) -> None:
        """Show a goal [g], as the task has it; None hides it."""
        if not self.drawable or (goal is not None and not np.isfinite(goal).all()):
            return
        if goal is None:
            self._handle.visible, self._shown = False, None
            return
        if self._shown is not None and np.array_equal(goal, self._shown):
            return
        self._shown = np.array(goal, dtype=np.float64)
        with self._server.atomic():
            x, y, *above = self._shown
            self._handle.position = (x, y, above[0] if above else self._height)
            if self._size == 7:
                self._handle.wxyz = np.roll(self._shown[3:], 1) / np.linalg.norm(self._shown[3:])
            self._handle.visible = True

    async def _dragged(self, event: TransformControlsEvent) -> None:
        """A coroutine, which viser runs in the order of what happens."""
        assert self._on_drag is not None
        position = np.asarray(event.target.position, dtype=np.float64)
        goal = position if self._size != 2 else position[:2]
        if self._size == 7:
            goal = np.concatenate([position, np.roll(event.target.wxyz, -1)])
        if np.isfinite(goal).all():
            self._shown = goal
            self._on_drag(goal, event.phase == "end")


def _draw_region(server: viser.ViserServer, name: str, region: Region, size: int, height: float) -> None:
    scene = server.scene
    mesh: trimesh.Trimesh | None = None
    if isinstance(region, Ring):
        mesh = trimesh.creation.annulus(r_min=region.inner, r_max=region.outer, height=0.002, sections=72)
        mesh.apply_translation([0.0, 0.0, height])
    elif isinstance(region, Ball):
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=region.radius)
        mesh.apply_translation(region.center)
    elif isinstance(region, Box):
        low, high = (np.pad(bound[: min(size, 3)], (0, max(0, 3 - size))) for bound in region.bounds)
        mesh = trimesh.creation.box(extents=np.maximum(high - low, 0.002))
        mesh.apply_translation((low + high) / 2 + (0.0, 0.0, height if size == 2 else 0.0))
    elif isinstance(region, Reachable):
        points = np.array(region.examples).reshape(-1, size)[:, : min(size, 3)]
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])), constant_values=height)
        scene.add_point_cloud(name, points.astype(np.float32), _BLUE, point_size=0.004, precision="float32")
    if mesh is not None:
        scene.add_mesh_simple(
            name,
            np.asarray(mesh.vertices),
            np.asarray(mesh.faces),
            color=_BLUE,
            opacity=0.07,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
