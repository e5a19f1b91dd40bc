"""Pictures of a robot and its goal, from a world of its own: looking never disturbs the simulation."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pybullet as bullet
from scipy.spatial.transform import Rotation

from physai.robots import RobotSpec

_OUT_OF_SIGHT = (0.0, 0.0, -100.0)


class Viewer:
    """Shows one robot with its goal, in a window or as images.

    Args:
        spec: The robot.
        height: Height of the tip in the home pose, m; a goal of a robot that stands up is a pole of that height.
        reach: Length of the arm, m; sets the camera's distance.
        tolerance: Radius of the goal's marker, m.
        window: Open a window; otherwise images are rendered on the CPU without a screen.
        width: Of an image, pixels.
        image_height: Of an image, pixels.
    """

    def __init__(
        self,
        spec: RobotSpec,
        height: float,
        reach: float,
        tolerance: float,
        window: bool = False,
        width: int = 480,
        image_height: int = 360,
    ) -> None:
        self._size = width, image_height
        self._window = window
        self._client = bullet.connect(bullet.GUI if window else bullet.DIRECT)
        flags = bullet.URDF_USE_MATERIAL_COLORS_FROM_MTL
        self._body = bullet.loadURDF(str(spec.urdf), useFixedBase=True, flags=flags, physicsClientId=self._client)
        infos = [
            bullet.getJointInfo(self._body, joint, self._client)
            for joint in range(bullet.getNumJoints(self._body, self._client))
        ]
        indices = {info[1].decode(): info[0] for info in infos}
        self._joints = [indices[name] for name in spec.joints]
        upright = height > 0.2 * reach
        floor = 0.0 if upright else -0.08
        green = (0.10, 0.75, 0.32, 1)
        # What marks the goal, and the height of its centre: a disc of the tolerance's size, and a pole up to the tip.
        self._markers = [(self._cylinder(tolerance, 0.02, green), floor + 0.01)]
        if upright:
            self._markers.append((self._cylinder(0.2 * tolerance, height, green), 0.5 * height))
        self._ball = self._body_of(bullet.GEOM_SPHERE, green, radius=tolerance)  # of a goal in space
        self._frame = self._make_frame(0.16 * reach)  # and what shows how it is turned
        half = [1.6 * reach, 1.6 * reach, 0.005]
        plate = self._body_of(bullet.GEOM_BOX, (0.97, 0.97, 0.98, 1), halfExtents=half)
        bullet.resetBasePositionAndOrientation(plate, (0, 0, floor - 0.005), (0, 0, 0, 1), self._client)
        target = (0, 0, 0.42 * height if upright else -0.03)
        distance, pitch = (2.2 * reach, -25) if upright else (2.5 * reach, -58)
        self._view = bullet.computeViewMatrixFromYawPitchRoll(target, distance, 40, pitch, 0, 2)
        self._projection = bullet.computeProjectionMatrixFOV(40, width / image_height, 0.05, 10)
        if window:
            bullet.configureDebugVisualizer(bullet.COV_ENABLE_GUI, 0, physicsClientId=self._client)
            bullet.resetDebugVisualizerCamera(distance, 40, pitch, target, self._client)

    def _cylinder(self, radius: float, length: float, color: tuple[float, float, float, float]) -> int:
        return self._body_of(bullet.GEOM_CYLINDER, color, radius=radius, length=length)

    def _make_frame(self, length: float) -> int:
        """Axes x, y, z in red, green and blue, as one body whose origin is theirs."""
        turns = [Rotation.from_euler("y", 90, degrees=True), Rotation.from_euler("x", -90, degrees=True)]
        orientations = [turn.as_quat().tolist() for turn in (*turns, Rotation.identity())]
        shapes = bullet.createVisualShapeArray(
            shapeTypes=[bullet.GEOM_CYLINDER] * 3,
            radii=[0.045 * length] * 3,
            lengths=[length] * 3,
            rgbaColors=[(0.85, 0.1, 0.1, 1), (0.1, 0.7, 0.1, 1), (0.1, 0.2, 0.9, 1)],
            visualFramePositions=(np.eye(3) * length / 2).tolist(),
            visualFrameOrientations=orientations,
            physicsClientId=self._client,
        )
        return bullet.createMultiBody(baseVisualShapeIndex=shapes, physicsClientId=self._client)

    def _body_of(self, kind: int, color: tuple[float, float, float, float], **size: Any) -> int:
        shape = bullet.createVisualShape(kind, rgbaColor=color, physicsClientId=self._client, **size)
        return bullet.createMultiBody(baseVisualShapeIndex=shape, physicsClientId=self._client)

    def show(self, joint_position: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """Show a pose [n], rad, and a goal in the plane [2] or in space [3], m, or a pose [7].

        Returns:
            An image [height, width, 3] uint8, or None with a window.
        """
        for joint, position in zip(self._joints, joint_position.tolist(), strict=True):
            bullet.resetJointState(self._body, joint, position, 0.0, self._client)
        x, y, *above = goal.tolist()
        flat, turned = not above, len(above) > 1
        for marker, z in [*self._markers, (self._ball, 0.0 if flat else above[0])]:
            shown = flat != (marker == self._ball) and not turned
            place = (x, y, z) if shown else _OUT_OF_SIGHT
            bullet.resetBasePositionAndOrientation(marker, place, (0, 0, 0, 1), self._client)
        place, turn = ((x, y, above[0]), above[1:]) if turned else (_OUT_OF_SIGHT, (0, 0, 0, 1))
        bullet.resetBasePositionAndOrientation(self._frame, place, turn, self._client)
        if self._window:
            return None
        return picture(self._client, self._view, self._projection, self._size)

    def close(self) -> None:
        """Close the window and free the world; may be called twice."""
        if self._client >= 0:
            bullet.disconnect(self._client)
            self._client = -1


def picture(client: int, view: Sequence[float], projection: Sequence[float], size: tuple[int, int]) -> np.ndarray:
    """Render a world on the CPU.

    Args:
        client: PyBullet's number of the world.
        view: Matrix of the camera's place, 16 numbers.
        projection: Matrix of the camera's lens, 16 numbers.
        size: Width and height, pixels.

    Returns:
        An image [height, width, 3] uint8.
    """
    width, height = size
    image = bullet.getCameraImage(
        width,
        height,
        view,
        projection,
        lightDirection=(0.6, -0.4, 2.0),
        shadow=1,
        lightAmbientCoeff=0.65,
        lightDiffuseCoeff=0.45,
        lightSpecularCoeff=0.05,
        renderer=bullet.ER_TINY_RENDERER,
        physicsClientId=client,
    )[2]
    return np.reshape(np.asarray(image, dtype=np.uint8), (height, width, 4))[..., :3].copy()
