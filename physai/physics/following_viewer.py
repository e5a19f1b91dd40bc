"""Pictures of a robot whose base floats, from a camera that goes along with it."""

from pathlib import Path

import numpy as np
import pybullet as bullet
import pybullet_data

from physai.physics.viewer import picture
from physai.robots import RobotSpec

_DISTANCE = 4.0  # of the camera, in heights of the base
_YAW, _PITCH = 40.0, -15.0  # degrees


class FollowingViewer:
    """Shows one robot on a chequered floor, in a window or as images, from a world of its own.

    Args:
        spec: The robot.
        window: Open a window; otherwise images are rendered on the CPU without a screen.
        width: Of an image, pixels.
        height: Of an image, pixels.
    """

    def __init__(self, spec: RobotSpec, window: bool = False, width: int = 480, height: int = 360) -> None:
        assert spec.floating is not None
        self._size, self._window = (width, height), window
        self._distance, self._middle = _DISTANCE * spec.floating.height, 0.7 * spec.floating.height
        self._client = bullet.connect(bullet.GUI if window else bullet.DIRECT)
        flags = bullet.URDF_USE_MATERIAL_COLORS_FROM_MTL
        self._body = bullet.loadURDF(str(spec.urdf), flags=flags, physicsClientId=self._client)
        floor = Path(pybullet_data.getDataPath()) / "plane.urdf"
        bullet.loadURDF(str(floor), useFixedBase=True, physicsClientId=self._client)
        infos = [
            bullet.getJointInfo(self._body, joint, self._client)
            for joint in range(bullet.getNumJoints(self._body, self._client))
        ]
        indices = {info[1].decode(): info[0] for info in infos}
        self._joints = [indices[name] for name in spec.joints]
        self._inertial = bullet.getDynamicsInfo(self._body, -1, self._client)[3:5]
        self._projection = bullet.computeProjectionMatrixFOV(40, width / height, 0.05, 20)
        if window:
            bullet.configureDebugVisualizer(bullet.COV_ENABLE_GUI, 0, physicsClientId=self._client)

    def show(self, joint_position: np.ndarray, base_pose: np.ndarray) -> np.ndarray | None:
        """Show joint positions [n], rad, and the pose of the base [7].

        Returns:
            An image [height, width, 3] uint8, or None with a window.
        """
        pose = base_pose.tolist()
        placed = bullet.multiplyTransforms(pose[:3], pose[3:], *self._inertial)
        bullet.resetBasePositionAndOrientation(self._body, *placed, self._client)
        for joint, position in zip(self._joints, joint_position.tolist(), strict=True):
            bullet.resetJointState(self._body, joint, position, 0.0, self._client)
        target = (pose[0], pose[1], self._middle)
        if self._window:
            bullet.resetDebugVisualizerCamera(self._distance, _YAW, _PITCH, target, self._client)
            return None
        view = bullet.computeViewMatrixFromYawPitchRoll(target, self._distance, _YAW, _PITCH, 0, 2)
        return picture(self._client, view, self._projection, self._size)

    def close(self) -> None:
        """Close the window and free the world; may be called twice."""
        if self._client >= 0:
            bullet.disconnect(self._client)
            self._client = -1
