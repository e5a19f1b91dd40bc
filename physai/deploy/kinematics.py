"""Where the links of a policy's robot are: for pictures, and for nothing else."""

from typing import Any

import numpy as np

from physai.collision import Kinematics, Motions
from physai.deploy.reading import PolicyError, array, items

_MOST_ENDS = 100
_FARTHEST = 1e3  # m; what is farther away overflows where it is drawn
_ANGLES = np.array([0.0, 0.25, 0.5, 1.0, 1.5]) * np.pi  # whoever keeps lengths and angles at these does so at all


def read_kinematics(raw: dict[str, Any], joints: int) -> Kinematics:
    """Return what a policy's metadata tell of so many joints.

    Raises:
        PolicyError: If a part is missing, of the wrong shape, or impossible; it says which.
    """
    constant, cosine, sine = (array(raw, f"kinematics.{key}", (joints, 4, 4)) for key in ("constant", "cosine", "sine"))
    count = len(items(raw, "kinematics.ends", _MOST_ENDS, "frames"))
    ends = array(raw, "kinematics.ends", (count, 4, 4))
    if any(np.abs(part).max() > _FARTHEST for part in (constant, cosine, sine, ends)):
        raise PolicyError(f"metadata: kinematics: a number is beyond {_FARTHEST:g}")
    if not all(_is_rigid(constant + np.cos(angle) * cosine + np.sin(angle) * sine) for angle in _ANGLES):
        raise PolicyError("metadata: kinematics: what a joint does is not a rigid motion")
    if not (np.abs(sine).max(axis=(1, 2)) > 0.5).all():  # of a turn, it holds an axis
        raise PolicyError("metadata: kinematics: a joint does not turn")
    if not _is_rigid(ends):
        raise PolicyError("metadata: kinematics.ends must be frames")
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
    if not 0 <= height <= _FARTHEST:
        raise PolicyError(f"metadata: kinematics.height must be between 0 and {_FARTHEST:g} m")
    return Kinematics(motions, tuple(zip(map(int, end_carriers), ends, strict=True)), height)


def _is_rigid(frames: np.ndarray) -> bool:
    """Whether all of [k, 4, 4] keep lengths and angles, and mirror nothing."""
    turn = frames[:, :3, :3]
    keeps = np.allclose(turn.transpose(0, 2, 1) @ turn, np.eye(3), atol=1e-6)
    in_space = np.allclose(frames[:, 3], [0.0, 0.0, 0.0, 1.0], atol=1e-6)
    return keeps and in_space and bool((np.linalg.det(turn) > 0).all())
