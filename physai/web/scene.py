"""A robot in a viser scene."""

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from physai.web.appearance import Appearance

_NO_UNIT = 0.1  # by which the length of a quaternion may be off


def on_the_spot(pose: np.ndarray) -> np.ndarray:
    """Return a pose [7] of a robot that walks, m and quaternion, without the way that it has gone."""
    return np.array([0.0, 0.0, *pose[2:]])


class RobotScene:
    """Draws one robot; several may stand in one scene.

    Args:
        server: Where to draw it.
        name: A name of its own in the scene, such as ``arm1``.
        appearance: What to draw.
        position: Where its base stands, m.

    Attributes:
        root: Name of the node where it stands, the frame of a fixed base; what is added below goes with it.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        appearance: Appearance,
        position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.appearance = appearance
        self.root = f"/{name}"
        self._server = server
        self._stand = server.scene.add_frame(self.root, show_axes=False, position=position)
        self._base = server.scene.add_frame(f"{self.root}/base", show_axes=False)
        self._bodies = [
            None if gltf is None else server.scene.add_glb(f"{self.root}/base/body{number}", gltf)
            for number, gltf in enumerate(appearance.bodies)
        ]
        self._shown = np.full(appearance.joints, np.nan)
        self.show(np.zeros(appearance.joints))

    def show(self, joint_position: np.ndarray) -> None:
        """Show it at joint positions [n], rad; from any thread. Numbers that are not finite leave it as it is.

        Raises:
            ValueError: If there are not n of them.
        """
        wanted = np.asarray(joint_position, dtype=np.float64)
        if wanted.shape != self._shown.shape:
            raise ValueError(f"{len(self._shown)} joint positions are needed, not {wanted.shape}")
        if not np.isfinite(wanted).all() or np.array_equal(wanted, self._shown):
            return
        self._shown = wanted
        frames = self.appearance.frames(wanted)
        turns = np.roll(Rotation.from_matrix(frames[:, :, :3]).as_quat(), 1, axis=1)  # w first
        with self._server.atomic():
            for body, frame, turn in zip(self._bodies[1:], frames[1:], turns[1:], strict=True):
                if body is not None:
                    body.position, body.wxyz = frame[:, 3], turn

    def move_base(self, pose: np.ndarray) -> None:
        """Show a base that floats at x, y, z, m, and a quaternion x, y, z, w, [7], from where the robot stands."""
        if np.isfinite(pose).all():
            with self._server.atomic():
                self._base.position, self._base.wxyz = pose[:3], np.roll(pose[3:], 1)

    def turn_base(self, turn: np.ndarray, height: float) -> None:
        """Show a robot whose drawing begins at the floor turned about its base.

        Args:
            turn: Quaternion x, y, z, w, [4]; what is none leaves it as it is.
            height: Of the base above the floor, m.
        """
        if abs(np.linalg.norm(turn) - 1.0) < _NO_UNIT:  # and of numbers that are not finite, nothing is near
            center = np.array([0.0, 0.0, height])
            with self._server.atomic():
                self._base.position = center - Rotation.from_quat(turn).apply(center)
                self._base.wxyz = np.roll(turn / np.linalg.norm(turn), 1)

    def place(self, position: tuple[float, float, float]) -> None:
        """Have it stand elsewhere, m."""
        self._stand.position = position

    def remove(self) -> None:
        """Take it out of the scene, with all that was added below its root."""
        self._stand.remove()
