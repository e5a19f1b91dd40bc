"""Where the links of a policy's robot are: for pictures, and for nothing else."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from physai.collision import Motions
from physai.deploy.reading import PolicyError, array, get

_PARTS = ("constant", "cosine", "sine")
_MOST_FEET = 100
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
        told = {key: getattr(self.motions, key).tolist() for key in _PARTS}
        if not self.height:
            ((_, tip),) = self.ends
            return told | {"tip": tip.tolist()}
        feet = [[body, *frame[:3, 3].tolist()] for body, frame in self.ends]
        return told | {"carriers": list(self.motions.carriers), "feet": feet, "height": self.height}

    @classmethod
    def read(cls, raw: dict[str, Any], joints: int) -> "Kinematics | None":
        """Return what a policy's metadata tell of so many joints; None if they tell nothing.

        Raises:
            PolicyError: If a part is missing, of the wrong shape, or impossible; it says which.
        """
        if "kinematics" not in raw:
            return None
        constant, cosine, sine = (array(raw, f"kinematics.{key}", (joints, 4, 4)) for key in _PARTS)
        if "feet" not in get(raw, "kinematics", dict):
            tip = array(raw, "kinematics.tip", (4, 4))
            _check_size(constant, cosine, sine, tip)
            return cls(Motions(constant, cosine, sine), ((joints, tip),))
        carriers = array(raw, "kinematics.carriers", (joints,))
        feet = get(raw, "kinematics.feet", list)
        if not 0 < len(feet) <= _MOST_FEET:
            raise PolicyError("metadata: kinematics.feet must be a list of places")
        places = array(raw, "kinematics.feet", (len(feet), 4))
        _check_size(constant, cosine, sine, places)
        bodies = np.concatenate([carriers, places[:, 0]])
        if not (bodies == bodies.round()).all() or not ((bodies >= 0) & (bodies <= joints)).all():
            raise PolicyError(f"metadata: kinematics: bodies must be numbered from 0 to {joints}")
        try:
            motions = Motions(constant, cosine, sine, tuple(map(int, carriers)))
        except ValueError as error:
            raise PolicyError(f"metadata: kinematics: {error}") from error
        height = float(array(raw, "kinematics.height", ()))
        if not 0 < height < 100:
            raise PolicyError("metadata: kinematics.height must be positive, and below 100 m")
        return cls(motions, tuple((int(body), _at(place)) for body, *place in places), height)


def _check_size(*parts: np.ndarray) -> None:
    if any(np.abs(part).max() > _FARTHEST for part in parts):
        raise PolicyError(f"metadata: kinematics: a number is beyond {_FARTHEST:g}")


def _at(place: list[float]) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, 3] = place
    return frame
