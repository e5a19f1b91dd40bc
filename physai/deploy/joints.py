"""Joint states from outside: mapped by name, checked, and refused where they cannot be true."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physai.deploy.metadata import Metadata
from physai.deploy.parameters import ControllerConfig

_ENCODER_NOISE = 0.01  # rad; what two readings of a still joint may differ by, however close in time


@dataclass(frozen=True)
class JointState:
    """What sensor_msgs/JointState carries.

    Attributes:
        names: Joint names, in any order; more than the policy's are welcome.
        position: rad, one a name.
        velocity: rad/s, one a name, or empty.
        stamp: When it was measured, s, by the clock of its source; orders states and gives the time between them.
        received: When it came in, s, by the clock of ``Controller.update``; None means now. A state that is known to
            have travelled for long is given the time at which it set out.
    """

    names: Sequence[str]
    position: Sequence[float]
    velocity: Sequence[float]
    stamp: float
    received: float | None = None


class JointStateError(Exception):
    """A joint state that cannot be used: ``kind`` for counting, a line for people.

    Attributes:
        implausible: Whether it is well formed but cannot be true, so that the arm must stop at once.
    """

    def __init__(self, kind: str, message: str, implausible: bool = False) -> None:
        super().__init__(f"joint state rejected: {message}")
        self.kind = kind
        self.implausible = implausible


class JointReader:
    """Turns joint states into positions and velocities in the policy's order, and remembers the last well-formed one.

    Args:
        metadata: Names and limits of the joints.
        config: ``jump_factor``, ``allow_velocity_estimate`` and ``state_timeout`` are used.
    """

    def __init__(self, metadata: Metadata, config: ControllerConfig) -> None:
        self._joints = metadata.joints
        self._velocity_limit = metadata.velocity_limit
        self._continuous = np.isinf(metadata.position_limit).all(axis=1)
        self.configure(config)
        self._names: tuple[str, ...] = ()
        self._index: list[int] = []
        self._before: tuple[np.ndarray, float, float] | None = None  # position, stamp, received

    def configure(self, config: ControllerConfig) -> None:
        """Take other values of these."""
        self._speed = self._velocity_limit * config.jump_factor
        self._estimate = config.allow_velocity_estimate
        self._timeout = config.state_timeout

    def read(self, state: JointState, received: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [n] rad and velocities [n] rad/s of a state that was received at a time, s.

        Raises:
            JointStateError: If it cannot be used, and why.
        """
        try:
            return self._read(state, received)
        except (TypeError, ValueError, OverflowError) as error:  # names, stamps or lists that are none
            raise JointStateError("malformed", f"it is malformed ({str(error)[:60]})") from None

    def _read(self, state: JointState, received: float) -> tuple[np.ndarray, np.ndarray]:
        names = tuple(state.names)
        if names != self._names or not self._index:
            self._index, self._names = self._map(names), names
        position = _numbers(state.position, len(names), "position")[self._index]
        _finite(position, "position")
        velocity = _numbers(state.velocity, len(names), "velocity") if len(state.velocity) else None
        stamp = to_float(state.stamp)
        if not math.isfinite(stamp):
            raise JointStateError("stamp not finite", "its stamp is not finite")
        before, self._before = self._before, (position, stamp, received)
        elapsed, moved = 0.0, np.zeros(len(position))
        if before is not None:
            elapsed = stamp - before[1]
            # Some drivers count a continuous joint from -π to π: the shorter way around is what it has moved.
            moved = position - before[0]
            around = moved - 2 * math.pi * np.round(moved / (2 * math.pi))
            moved = np.where(self._continuous, around, moved)
            # A source whose stamps run ahead must not make room for jumps.
            self._check_motion(moved, min(elapsed, max(0.0, received - before[2]) + self._timeout))
        velocity = np.full(len(position), np.nan) if velocity is None else velocity[self._index]
        unknown = ~np.isfinite(velocity)
        if unknown.any():
            if not self._estimate:
                raise JointStateError("velocity missing", "a velocity is missing or not finite")
            if before is None or elapsed > self._timeout:
                raise JointStateError("velocity missing", "a velocity is missing, and so is a recent position")
            estimate = np.clip(moved / elapsed, -self._speed, self._speed)
            velocity = np.where(unknown, estimate, velocity)
        if (np.abs(velocity) > self._speed).any():
            raise JointStateError("velocity implausible", f"velocities {velocity.tolist()} rad/s cannot be true", True)
        return position, velocity

    def _map(self, names: tuple[str, ...]) -> list[int]:
        if len(set(names)) != len(names):
            raise JointStateError("duplicate name", "a joint is named twice")
        for joint in self._joints:
            if joint not in names:
                raise JointStateError("joint missing", f"joint '{joint}' is missing")
        return [names.index(joint) for joint in self._joints]

    def _check_motion(self, moved: np.ndarray, elapsed: float) -> None:
        if elapsed == 0:
            raise JointStateError("stamp repeated", "its stamp is that of the state before", True)
        if elapsed < 0:
            raise JointStateError("stamp backwards", f"its stamp runs {-elapsed:.3f} s backwards", True)
        far = ~(np.abs(moved) <= self._speed * elapsed + _ENCODER_NOISE)  # also where it is NaN: of numbers too large
        if far.any():
            joint = int(far.argmax())
            text = f"'{self._joints[joint]}' jumped by {moved[joint]:.3f} rad in {elapsed:.3f} s"
            raise JointStateError("position jump", text, True)


def to_float(value: float) -> float:
    """Return a time as a float.

    Raises:
        JointStateError: If it is no number.
    """
    array = to_floats(value)
    if array is None or array.shape:
        raise JointStateError("malformed", "its stamp, or the time of its receipt, is no number")
    return float(array)


def to_floats(values: Sequence[float] | float) -> np.ndarray | None:
    """Return numbers as float64; None if they are no numbers (text is none, whatever it says)."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, OverflowError):
        return None
    return array.astype(np.float64) if array.dtype.kind in "fiu" else None


def _numbers(values: Sequence[float], count: int, what: str) -> np.ndarray:
    array = to_floats(values)
    if array is None:
        raise JointStateError("malformed", f"its {what} is not a list of numbers")
    if array.shape != (count,):
        raise JointStateError("lengths disagree", f"{count} names, but {what} has the shape {list(array.shape)}")
    return array


def _finite(array: np.ndarray, what: str) -> None:
    if not np.isfinite(array).all():
        raise JointStateError(f"{what} not finite", f"a {what} is not finite")
