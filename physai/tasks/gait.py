"""A trot: the paths that feet take about their places at home, and the joints that lead them there."""

from dataclasses import dataclass

import numpy as np

from physai.config import Config, NonNegativeFloat, PositiveFloat
from physai.errors import UserError
from physai.robots import RobotSpec, ends_at_home

_NEAR = 1e-3  # m from the middle, and m/rad that move no foot


class Sway(Config):
    """How far a foot is from home at the ``start`` and in the ``middle`` of its swing, m; then the other way."""

    start: float
    middle: float


class Gait(Config):
    """How four feet step: those of one diagonal swing in the first half of a period, and the others in the second.

    Attributes:
        frequency: Of the periods, Hz.
        lift: About how high a foot goes in its swing, m.
        reach: How far ahead of its way it is in the middle of its swing, m.
        forward: How it sways forward, all the time.
        outward: How it sways away from the robot's middle line, all the time.
        stride: How much of the way that the base goes in a stance the foot covers; 1 in theory.
        yaw_correction: How far the feet turn about the base for what the yaw rate lacks, s.
    """

    frequency: PositiveFloat
    lift: NonNegativeFloat
    reach: float
    forward: Sway
    outward: Sway
    stride: PositiveFloat
    yaw_correction: NonNegativeFloat


@dataclass(frozen=True)
class JointGait:
    """What n joints do for a gait: offsets from home, rad.

    Attributes:
        phase: Share of a period at which each joint begins, [n].
        swing: In the middle of the swing, [n].
        sway: At the start of the swing, and in its middle, [2, n].
        stride: At the start of the swing, for each m/s forward and to the left, and each rad/s, [3, n].
        yaw_correction: For each rad/s that the yaw rate lacks, [n].
    """

    phase: np.ndarray
    swing: np.ndarray
    sway: np.ndarray
    stride: np.ndarray
    yaw_correction: np.ndarray


def joint_gait(gait: Gait, spec: RobotSpec) -> JointGait:
    """Lead the feet with the joints, by the inverse of their Jacobian at home.

    Raises:
        UserError: If there is no foot at each of four corners, each with legs of its own, or the knees are straight.
    """
    places, jacobian = _feet_at_home(spec)
    x, y = places[:, 0], places[:, 1]
    ahead, aside = x - x.mean(), y - y.mean()
    corners = {(a > 0, b > 0) for a, b in zip(ahead, aside, strict=True) if min(abs(a), abs(b)) > _NEAR}
    moved = np.abs(jacobian).max(axis=1) > _NEAR  # which feet each joint moves, [f, n]
    if len(places) != 4 or len(corners) != 4 or (moved.sum(axis=0) > 1).any():
        raise UserError(f"robot '{spec.name}': a trot needs four feet, one at each corner, with a leg of its own")
    forward, left, up = np.broadcast_to(np.eye(3)[:, np.newaxis], (3, 4, 3))
    outward = left * np.sign(aside)[:, np.newaxis]
    turn = forward * -y[:, np.newaxis] + left * x[:, np.newaxis]  # about the base, m for each rad
    # A foot that stands goes backwards as the base goes forward, from half of the way before home to half behind it.
    stance = gait.stride / (4.0 * gait.frequency)
    paths = [
        gait.reach * forward + gait.lift * up,
        gait.forward.start * forward + gait.outward.start * outward,
        gait.forward.middle * forward + gait.outward.middle * outward,
        *(-stance * way for way in (forward, left, turn)),
        -gait.yaw_correction * turn,
    ]
    led = np.linalg.pinv(jacobian.reshape(-1, len(spec.joints))) @ np.reshape(paths, (len(paths), -1)).T  # [n, 7]
    lifted = jacobian[:, 2] @ led[:, 0]
    if np.abs(led[:, 0]).max() > np.pi / 2 or np.abs(lifted - gait.lift).max() > 0.1 * gait.lift + 1e-6:
        raise UserError(f"robot '{spec.name}': its legs are too straight to lift the feet: bend the knees in 'home'")
    foot = moved.argmax(axis=0)  # of each joint, [n]
    return JointGait(np.where(ahead * aside > 0, 0.5, 0.0)[foot], led[:, 0], led[:, 1:3].T, led[:, 3:6].T, led[:, 6])


def _feet_at_home(spec: RobotSpec) -> tuple[np.ndarray, np.ndarray]:
    """The same as of all ends, but of one place a foot, though it may have several spheres."""
    assert spec.floating is not None
    places, jacobian = ends_at_home(spec)
    links = [sphere.link for sphere in spec.floating.spheres if sphere.link in spec.floating.foot_links]
    rows = [np.array(links) == link for link in dict.fromkeys(links)]
    return np.stack([places[row].mean(axis=0) for row in rows]), np.stack([jacobian[row].mean(axis=0) for row in rows])
