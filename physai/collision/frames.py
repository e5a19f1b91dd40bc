"""Where the bodies of a robot are, and where its links end: the forward kinematics of all of them, in NumPy."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Motions:
    """What each driven joint does to the points of the body that it moves.

    By Rodrigues' formula a turning joint is ``M(q) = A + B cos(q) + C sin(q)``; A also holds the fixed transform before
    the joint. Body k + 1's frame is that of the body which carries joint k, times this; body 0's is the base's.

    Attributes:
        constant: A, [n, 4, 4].
        cosine: B, [n, 4, 4].
        sine: C, [n, 4, 4].
        carriers: Which body carries each joint, [n], such as the base for the first joint of each leg; empty of an arm,
            whose bodies carry one joint each.

    Raises:
        ValueError: If they are not of that shape, a number is not finite, or a carrier comes after what it carries.
    """

    constant: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray
    carriers: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for key in ("constant", "cosine", "sine"):
            try:
                matrices = np.asarray(getattr(self, key), dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise ValueError(f"motions: {key} is no array of numbers") from error
            if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
                raise ValueError(f"motions: {key} must be 4 x 4 for each joint, not {list(matrices.shape)}")
            if not np.isfinite(matrices).all():
                raise ValueError(f"motions: {key} has a number that is not finite")
            object.__setattr__(self, key, matrices)
        if not len(self.constant) == len(self.cosine) == len(self.sine):
            counts = len(self.constant), len(self.cosine), len(self.sine)
            raise ValueError(f"motions: constant, cosine and sine are of {counts} joints")
        carriers = self.carriers or tuple(range(len(self)))
        if len(carriers) != len(self) or not all(0 <= body <= joint for joint, body in enumerate(carriers)):
            raise ValueError(f"motions: carriers must be a body for each joint that comes before it, not {carriers}")
        object.__setattr__(self, "carriers", carriers)

    def __len__(self) -> int:
        return len(self.constant)

    def frames(self, joint_position: np.ndarray) -> np.ndarray:
        """Return the frame of each body in the base's.

        The robots come last: what NumPy does to rows of N numbers it does fast, and alike for any N.

        Args:
            joint_position: rad, [N, n].

        Returns:
            Rotation, then position in m, of n + 1 bodies, [n + 1, 3, 4, N].
        """
        angle = joint_position.T[:, np.newaxis, np.newaxis]
        motion = self.cosine[..., np.newaxis] * np.cos(angle)
        motion += self.sine[..., np.newaxis] * np.sin(angle)
        motion += self.constant[..., np.newaxis]  # [n, 4, 4, N]
        frames = np.empty((len(self) + 1, 3, 4, len(joint_position)))
        frames[0] = np.eye(4)[:3, :, np.newaxis]
        for carrier, moved, after in zip(self.carriers, motion, frames[1:], strict=True):
            np.add.reduce(frames[carrier][:, :, np.newaxis] * moved, axis=1, out=after)
        return frames


@dataclass(frozen=True, eq=False)
class Kinematics:
    """What each joint of a robot moves, and where its links end.

    Attributes:
        motions: Of the n joints.
        ends: Places where links end without a joint, each the number of a body and its frame there, 4 x 4: of an arm
            the end effector, of legs the feet.
        height: Of the base above the floor while a robot on legs stands at home, m; 0 of arms.
    """

    motions: Motions
    ends: tuple[tuple[int, np.ndarray], ...]
    height: float = 0.0

    def places(self, joint_position: np.ndarray) -> np.ndarray:
        """Return where the e ends are at joint positions [N, n], rad, in the base's frame, m, [e, 3, N]."""
        frames = self.motions.frames(joint_position)
        return np.stack([np.einsum("ijr,j->ir", frames[body], end[:, 3]) for body, end in self.ends])

    def describe(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return {
            **{key: getattr(self.motions, key).tolist() for key in ("constant", "cosine", "sine")},
            "carriers": list(self.motions.carriers),
            "end_carriers": [body for body, _ in self.ends],
            "ends": [frame.tolist() for _, frame in self.ends],
            "height": self.height,
        }
