"""Where the links of a policy's robot are: for pictures, and for nothing else."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from physai.collision import Motions
from physai.deploy.reading import PolicyError, array, items

_PARTS = ("constant", "cosine", "sine")
_MOST_ENDS = 100
_FARTHEST = 1e3  # m; what is farther away overflows where it is drawn


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

    def describe(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return {
            **{key: getattr(self.motions, key).tolist() for key in _PARTS},
            "carriers": list(self.motions.carriers),
            "end_carriers": [body for body, _ in self.ends],
            "ends": [frame.tolist() for _, frame in self.ends],
            "height": self.height,
        }

    @classmethod
    def read(cls, raw: dict[str, Any], joints: int) -> "Kinematics | None":
        """Return what a policy's metadata tell of so many joints; None if they tell nothing.

        Raises:
            PolicyError: If a part is missing, of the wrong shape, or impossible; it says which.
        """
        if "kinematics" not in raw:
            return None
        constant, cosine, sine = (array(raw, f"kinematics.{key}", (joints, 4, 4)) for key in _PARTS)
        count = len(items(raw, "kinematics.ends", _MOST_ENDS, "frames"))
        ends = array(raw, "kinematics.ends", (count, 4, 4))
        if any(np.abs(part).max() > _FARTHEST for part in (constant, cosine, sine, ends)):
            raise PolicyError(f"metadata: kinematics: a number is beyond {_FARTHEST:g}")
        carriers = array(raw, "kinematics.carriers", (joints,))
        end_carriers = array(raw, "kinematics.end_carriers", (count,))
        bodies = np.concatenate([carriers, end_carriers])
        if not (bodies == bodies.round()).all() or not ((bodies >= 0) & (bodies <= joints)).all():
            raise PolicyError(f"metadata: kinematics: bodies must be numbered from 0 to {joints}")
        try:
            motions = Motions(constant, cosine, sine, tuple(map(int, carriers)))
        except ValueError as error:
            raise PolicyError(f"metadata: kinematics: {error}") from error
        height = float(array(raw, "kinematics.height", ()))
        if not 0 <= height < _FARTHEST:
            raise PolicyError("metadata: kinematics.height must not be negative, nor beyond 1000 m")
        return cls(motions, tuple(zip(map(int, end_carriers), ends, strict=True)), height)
