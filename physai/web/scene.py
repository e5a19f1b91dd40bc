"""A robot in a viser scene."""

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from physai.web.appearance import Appearance


class RobotScene:
    """Draws one robot; several may stand in one scene.

    Args:
        server: Where to draw it.
        name: A name of its own in the scene, such as ``arm1``.
        appearance: What to draw.
        position: Where its base stands, m.

    Attributes:
        root: Name of the node in the frame of the robot's base; what is added below stands and goes with it.
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
        self._base = server.scene.add_frame(self.root, show_axes=False, position=position)
        self._bodies = [
            None if gltf is None else server.scene.add_glb(f"{self.root}/body{number}", gltf)
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

    def place(self, position: tuple[float, float, float]) -> None:
        """Put its base elsewhere, m."""
        self._base.position = position

    def remove(self) -> None:
        """Take it out of the scene, with all that was added below its root."""
        self._base.remove()
