"""Joint states from outside: mapped by name, checked, merged, and refused where they cannot be true."""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from physai.deploy.metadata import Metadata
from physai.deploy.parameters import ControllerConfig

_ENCODER_NOISE = 0.01  # rad; what two readings of a still joint may differ by, however close in time


@dataclass(frozen=True)
class JointState:
    """What sensor_msgs/JointState carries, of the whole robot or of a part of it.

    Attributes:
        names: Joint names, in any order; more than the policy's are welcome, and so are fewer.
        position: rad, one a name.
        velocity: rad/s, one a name, or empty.
        stamp: When it was measured, s, by the clock of its source; orders states and gives the time between them.
        received: When it came in, s, by the clock of ``Controller.update``; None means now. A state that is known to
            have travelled for long is given the time at which it set out.
        effort: N·m, one a name, or empty; NaN where it is not known.
        source: Who says so, if that is known; another source than before may be another robot.
    """

    names: Sequence[str]
    position: Sequence[float]
    velocity: Sequence[float]
    stamp: float
    received: float | None = None
    effort: Sequence[float] = ()
    source: Hashable = None


class JointStateError(Exception):
    """A joint state that cannot be used: ``kind`` for counting, a line for people.

    Attributes:
        implausible: Whether it is well formed but cannot be true, so that the arm must stop at once.
    """

    def __init__(self, kind: str, message: str, implausible: bool = False) -> None:
        super().__init__(f"joint state rejected: {message}")
        self.kind = kind
        self.implausible = implausible


class Heard(NamedTuple):
    """What a good joint state brought.

    Attributes:
        complete: Whether, with it, every joint has been heard of since the last time that this was so.
        another: A joint that comes from another source than before, or None.
    """

    complete: bool
    another: str | None


class _Names(NamedTuple):
    """Where the policy's joints stand in messages with these names."""

    names: tuple[str, ...]
    places: np.ndarray  # in the message
    joints: np.ndarray | slice  # in the policy's order; a slice, which is faster, where it is all of them
    found: int


class JointReader:
    """Merges joint states, joint by joint, into what is known of the robot, in the policy's order.

    Args:
        metadata: Names and limits of the joints.
        config: ``jump_factor``, ``allow_velocity_estimate`` and ``state_timeout`` are used.

    Attributes:
        position: rad, [n]; the attributes are those of the last good states, and NaN where there is none yet.
        turned: The same, continuous joints between -π and π: what a policy of single precision can tell apart.
        received: When the joint was heard of that has not been heard of for longest, s; -inf if one never was.
        motion: The way that each joint has gone since the first state, rad, in which half a turn is no jump; then
            velocities, rad/s, [2 n].
        velocity: rad/s, [n].
        effort: N·m, [n]; NaN where no message has told it.
        feels: Whether one has.
    """

    def __init__(self, metadata: Metadata, config: ControllerConfig) -> None:
        self._joints = metadata.joints
        self._velocity_limit = metadata.velocity_limit
        self._continuous = np.isinf(metadata.position_limit).all(axis=1)
        self._endless = bool(self._continuous.any())
        self.configure(config)
        n = len(self._joints)
        self.position, self.turned, self.effort = (np.full(n, np.nan) for _ in range(3))
        self.motion = np.zeros(2 * n)
        self._travel, self.velocity = self.motion[:n], self.motion[n:]
        self.feels = False
        self.received = -math.inf
        self._received = np.full(n, -np.inf)
        self._fresh = np.zeros(n, dtype=bool)  # heard of since the robot was complete
        self._source: list[Hashable] = [None] * n
        # Of the last well-formed states, also of refused ones: if a joint stays where it has jumped to, it is there.
        self._last_position = np.full(n, np.nan)
        self._last_stamp, self._last_received = np.full(n, -np.inf), np.full(n, -np.inf)
        self._map: _Names | None = None

    def configure(self, config: ControllerConfig) -> None:
        """Take other values of these."""
        self._speed = self._velocity_limit * config.jump_factor
        self._estimate = config.allow_velocity_estimate
        self._timeout = config.state_timeout

    def oldest(self) -> str | None:
        """Name of the joint that has not been heard of for longest; None if all are equally old."""
        received = self._received
        return None if (received == received[0]).all() else self._joints[int(received.argmin())]

    def read(self, state: JointState, now: float) -> Heard | None:
        """Take a state at a time, s; None if it names none of the policy's joints.

        Raises:
            JointStateError: If it cannot be used, and why.
        """
        try:
            return self._read(state, now)
        except (TypeError, ValueError, OverflowError) as error:  # names, stamps or lists that are none
            raise JointStateError("malformed", f"it is malformed ({str(error)[:60]})") from error

    def _read(self, state: JointState, now: float) -> Heard | None:
        names = tuple(state.names)
        if self._map is None or names != self._map.names:
            self._map = self._find(names)
        _, places, joints, found = self._map
        if not found:
            return None
        position = _numbers(state.position, len(names), "position")[places]
        if not np.isfinite(position).all():
            raise JointStateError("position not finite", "a position is not finite")
        velocity = _numbers(state.velocity, len(names), "velocity")[places] if len(state.velocity) else None
        effort = _numbers(state.effort, len(names), "effort")[places] if len(state.effort) else None
        stamp = to_float(state.stamp)
        if not math.isfinite(stamp):
            raise JointStateError("stamp not finite", "its stamp is not finite")
        received = now if state.received is None else min(to_float(state.received), now)
        moved, elapsed = self._check_motion(joints, position, stamp, received)
        velocity = self._check_velocity(velocity, moved, elapsed, joints)
        if not now - received <= self._timeout:  # also where it is NaN
            raise JointStateError("old on arrival", f"it is {now - received:.3f} s old", implausible=True)
        self.position[joints], self.velocity[joints] = position, velocity
        if self.feels or effort is not None:
            self.feels = True
            self.effort[joints] = math.nan if effort is None else effort
        turned = self._endless and np.abs(self.position).max() > math.pi
        self.turned = np.where(self._continuous, _half_turn(self.position), self.position) if turned else self.position
        self._received[joints] = received
        return Heard(self._complete(joints, found, received), self._check_source(joints, state.source))

    def _complete(self, joints: np.ndarray | slice, found: int, received: float) -> bool:
        if found == len(self._joints):
            self.received = received
        else:
            self.received = float(self._received.min())
            self._fresh[joints] = True
            if not self._fresh.all():
                return False
        self._fresh[:] = False
        return True

    def _find(self, names: tuple[str, ...]) -> _Names:
        found = [(names.index(joint), number) for number, joint in enumerate(self._joints) if joint in names]
        if found and len(set(names)) != len(names):
            raise JointStateError("duplicate name", "a joint is named twice")
        in_message, in_policy = np.array(found, dtype=int).reshape(-1, 2).T
        whole = len(found) == len(self._joints)
        return _Names(names, in_message, slice(None) if whole else in_policy, len(found))

    def _check_motion(
        self, joints: np.ndarray | slice, position: np.ndarray, stamp: float, received: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how far the joints have moved, rad, and in which time, s (infinite for new ones)."""
        moved = position - self._last_position[joints]
        elapsed, passed = stamp - self._last_stamp[joints], received - self._last_received[joints]
        self._last_position[joints], self._last_stamp[joints], self._last_received[joints] = position, stamp, received
        shortest, far = float(elapsed.min()), np.abs(moved)
        if self._endless and not far.max() < math.pi:
            # Some drivers count a continuous joint from -π to π: the shorter way around is what it has moved.
            moved = np.where(self._continuous[joints], _half_turn(moved), moved)
            far = np.abs(moved)
        if shortest <= 0:
            if shortest == 0:
                raise JointStateError("stamp repeated", "its stamp is that of the state before", True)
            raise JointStateError("stamp backwards", f"its stamp runs {-shortest:.3f} s backwards", True)
        new = elapsed == math.inf
        if self.received == -math.inf and new.any():
            moved = np.where(new, 0.0, moved)
            far = np.abs(moved)
        # A source whose stamps run ahead must not make room for jumps. (NaN: a time of receipt that is none.)
        allowed = np.minimum(elapsed, np.fmax(0.0, passed) + self._timeout)
        plausible = far <= self._speed[joints] * allowed + _ENCODER_NOISE  # nor NaN: of numbers too large
        if not plausible.all():
            joint = int(plausible.argmin())
            name = np.array(self._joints)[joints][joint]
            raise JointStateError(
                "position jump", f"'{name}' jumped by {moved[joint]:.3f} rad in {elapsed[joint]:.3f} s", True
            )
        self._travel[joints] += moved  # also where the rest of the state is refused: it is gone
        return moved, elapsed

    def _check_velocity(
        self, velocity: np.ndarray | None, moved: np.ndarray, elapsed: np.ndarray, joints: np.ndarray | slice
    ) -> np.ndarray:
        """Return velocities, rad/s, estimated where they are missing and that is allowed."""
        speed = self._speed[joints]
        velocity = np.full(len(moved), np.nan) if velocity is None else velocity
        if not (known := np.isfinite(velocity)).all():
            unknown = ~known
            if not self._estimate:
                raise JointStateError("velocity missing", "a velocity is missing or not finite")
            if (elapsed[unknown] > self._timeout).any():
                raise JointStateError("velocity missing", "a velocity is missing, and so is a recent position")
            velocity = np.where(unknown, np.clip(moved / elapsed, -speed, speed), velocity)
        if not (np.abs(velocity) <= speed).all():
            raise JointStateError("velocity implausible", f"velocities {velocity.tolist()} rad/s cannot be true", True)
        return velocity

    def _check_source(self, joints: np.ndarray | slice, source: Hashable) -> str | None:
        if source is None:
            return None
        another = None
        for joint in np.arange(len(self._joints))[joints].tolist():
            if self._source[joint] not in (None, source):
                another = self._joints[joint]
            self._source[joint] = source
        return another


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


def _half_turn(angle: np.ndarray) -> np.ndarray:
    """The same angle between -π and π, in double precision; one that lies there already keeps every bit."""
    return angle - 2 * math.pi * np.round(angle / (2 * math.pi))


def _numbers(values: Sequence[float], count: int, what: str) -> np.ndarray:
    array = to_floats(values)
    if array is None:
        raise JointStateError("malformed", f"its {what} is not a list of numbers")
    if array.shape != (count,):
        raise JointStateError("lengths disagree", f"{count} names, but {what} has the shape {list(array.shape)}")
    return array
