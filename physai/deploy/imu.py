"""What an inertial measurement unit tells of a base that floats: checked, and refused where it cannot be true."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physai.deploy.joints import JointStateError, to_float, to_floats

_LENGTH = 0.1  # by which that of a quaternion may differ from 1
_FASTEST = 40.0  # rad/s; the range of common gyroscopes is 2000 degrees a second, 35 rad/s
_MOVES = 0.5  # rad/s; where a joint is as fast, the numbers of an IMU change


@dataclass(frozen=True)
class Imu:
    """What sensor_msgs/Imu carries, of a unit whose axes are those of the base.

    Attributes:
        orientation: Quaternion x, y, z, w of the base in a world whose z axis points up.
        angular_velocity: About the axes of the base, rad/s.
        stamp: When it was measured, s, by the clock of its source.
        frame: Name of the frame of these axes.
        received: When it came in, s, by the clock of ``update``; None means now.
    """

    orientation: Sequence[float]
    angular_velocity: Sequence[float]
    stamp: float
    frame: str
    received: float | None = None


class ImuError(Exception):
    """A reading that cannot be used: ``kind`` for counting, a line for people.

    Attributes:
        implausible: Whether it is well formed but cannot be true, so that the robot must hold at once.
    """

    def __init__(self, kind: str, message: str, implausible: bool = False) -> None:
        super().__init__(f"IMU rejected: {message}")
        self.kind = kind
        self.implausible = implausible


class ImuReader:
    """Keeps the last good reading.

    Args:
        frame: The frame that readings must be in.
        timeout: For how long the numbers of a robot that moves may stay the same, s.

    Attributes:
        gravity: Direction of gravity along the axes of the base, [3]; NaN before the first reading.
        angular_velocity: rad/s, [3].
        received: When that was, s; -inf before the first one.
    """

    def __init__(self, frame: str, timeout: float) -> None:
        self._frame, self.timeout = frame, timeout
        self.gravity, self.angular_velocity = np.full((2, 3), np.nan)
        self.received = self._stamp = -math.inf
        self._changed: dict[str, float] = {}

    @property
    def tilt(self) -> float:
        """Angle between the base's z axis and up, rad; NaN before the first reading."""
        return math.acos(min(1.0, max(-1.0, -float(self.gravity[2]))))

    def read(self, imu: Imu, now: float, speed: float) -> None:
        """Take a reading.

        Args:
            imu: The reading.
            now: The time, s.
            speed: Of the fastest joint, rad/s.

        Raises:
            ImuError: If it cannot be used, and why.
        """
        told = (imu.orientation, imu.angular_velocity) if isinstance(imu, Imu) else ("", "")
        orientation, turns = map(to_floats, told)
        if orientation is None or turns is None or orientation.shape != (4,) or turns.shape != (3,):
            raise ImuError("malformed", "it does not hold four and three numbers")
        if not (np.isfinite(orientation).all() and np.isfinite(turns).all()):
            raise ImuError("not finite", "a number is not finite")
        if not abs((length := float(np.linalg.norm(orientation))) - 1.0) < _LENGTH:
            raise ImuError("not a rotation", f"its quaternion has the length {length:.3f}, not 1")
        if not isinstance(imu.frame, str):
            raise ImuError("malformed", "its frame is no name")
        if imu.frame != self._frame:
            raise ImuError("wrong frame", f"frame '{imu.frame}' is not '{self._frame}'")
        try:
            stamp = to_float(imu.stamp)
            received = now if imu.received is None else min(to_float(imu.received), now)
        except JointStateError as error:
            raise ImuError("malformed", "its stamp, or the time of its receipt, is no number") from error
        if not (math.isfinite(stamp) and math.isfinite(received)):
            raise ImuError("malformed", "its stamp, or the time of its receipt, is not finite")
        before, self._stamp = self._stamp, stamp
        if stamp <= before:
            how = "repeats" if stamp == before else f"runs {before - stamp:.3f} s behind"
            raise ImuError("stamp", f"its stamp {how} the one before", implausible=True)
        if (fastest := float(np.abs(turns).max())) > _FASTEST:
            raise ImuError("implausible", f"an angular velocity of {fastest:.0f} rad/s cannot be true", True)
        gravity = _down(orientation / length)
        for what, (value, last) in {
            "orientation": (gravity, self.gravity),
            "angular velocity": (turns, self.angular_velocity),
        }.items():
            if speed < _MOVES or not np.array_equal(value, last):
                self._changed[what] = received
            elif (frozen := received - self._changed[what]) > self.timeout:
                raise ImuError("frozen", f"its {what} is the same for {frozen:.2f} s, and joints move", True)
        self.gravity, self.angular_velocity, self.received = gravity, turns, received


def _down(quaternion: np.ndarray) -> np.ndarray:
    """Return the direction of gravity in a body with a unit quaternion."""
    x, y, z, w = quaternion.tolist()
    return np.array([2.0 * (w * y - x * z), -2.0 * (y * z + w * x), 2.0 * (x * x + y * y) - 1.0])
