"""A trot: the paths that feet take about their places at home, and the joints that lead them there."""

from dataclasses import dataclass

import numpy as np

from physai.config import Config, NonNegativeFloat, PositiveFloat
from physai.robots import RobotSpec, ends_at_home


class Sway(Config):
    """How far a foot is from home at the ``begin`` and in the ``middle`` of its swing, m; then the other way."""

    begin: float
    middle: float


class Gait(Config):
    """How the feet step; those of one diagonal swing in the first half of a period, and the others in the second.

    Attributes:
        frequency: Of the periods, Hz.
        lift: How high a foot goes in its swing, m.
        reach: How far ahead of its way it is in the middle of its swing, m.
        forward: How it sways forward, all the time.
        outward: How it sways away from the other side, all the time.
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
    """The same for the n joints, rad.

    Attributes:
        phase: Share of a period at which each joint begins, [n].
        lift: In the middle of the swing, [n].
        sway: At the beginning of the swing, and in its middle, [2, n].
        stride: At the beginning of the swing, for each m/s forward and to the left, and each rad/s, [3, n].
        yaw_correction: For each rad/s that the yaw rate lacks, [n].
    """

    phase: np.ndarray
    lift: np.ndarray
    sway: np.ndarray
    stride: np.ndarray
    yaw_correction: np.ndarray


def joint_gait(gait: Gait, spec: RobotSpec) -> JointGait:
    """Lead the feet with the joints, by the inverse of their Jacobian at home."""
    places, jacobian = ends_at_home(spec)
    x, y = places[:, 0], places[:, 1]
    forward, left, up = np.broadcast_to(np.eye(3)[:, np.newaxis], (3, len(places), 3))
    outward = left * np.sign(y)[:, np.newaxis]
    turn = forward * -y[:, np.newaxis] + left * x[:, np.newaxis]  # about the base, m for each rad
    # A foot that stands goes backwards as the base goes forward, from half of the way before home to half behind it.
    stance = gait.stride / (4.0 * gait.frequency)
    paths = [
        gait.reach * forward + gait.lift * up,
        gait.forward.begin * forward + gait.outward.begin * outward,
        gait.forward.middle * forward + gait.outward.middle * outward,
        *(-stance * way for way in (forward, left, turn)),
        -gait.yaw_correction * turn,
    ]
    led = np.linalg.pinv(jacobian.reshape(-1, len(spec.joints))) @ np.reshape(paths, (len(paths), -1)).T  # [n, 7]
    leg = np.abs(jacobian).max(axis=1).argmax(axis=0)  # which foot each joint moves most, [n]
    return JointGait(np.where(x * y > 0, 0.5, 0.0)[leg], led[:, 0], led[:, 1:3].T, led[:, 3:6].T, led[:, 6])
