"""Motions that begin at rest or at a steady speed, cut out of a recording: what an identification predicts."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from physai.errors import UserError
from physai.identify.recording import Recording
from physai.robots import RobotSpec

_STILL = 0.5  # s with one command, after which a robot has come to rest, or to a steady speed
_MEAN = 0.24  # s of this, from which it comes where a motion begins
_LONGEST = 4.0  # s; farther ahead, small errors grow and say little of parameters
_SHORTEST = 0.2  # s
_CREEPS = 4.0  # standard deviations of what noise does to a mean; and at least, rad and rad/s:
_RESTING = np.array([2e-4, 2e-3])
_STEADY = 0.1  # of a speed, by which it may change from half to half: an arm that sinks is never quite steady
_SHOWS = 3.0  # standard deviations, from which an acceleration does
_FEWEST, _MOST = 2, 40  # motions: one to learn from, one to judge by; and more hardly tell more
_LEAST_NOISE = np.array([1e-5, 1e-4])  # rad, rad/s; encoders resolve no more
_LEAST_SHARE = 0.01  # of the largest effort, to which it is known: sensors of torque have errors of scale, too
_NEAR_LIMIT = 0.05  # rad; zeros of encoders may be off by as much
_BEYOND_LIMIT = 0.02  # rad, by which a joint that begins at its limit may be beyond it
_HELD_OUT = 4  # one of so many motions
_LEAST_MOTION = 20.0  # times the noise of positions, that each joint must move in some trial


@dataclass(frozen=True)
class Trials:
    """B motions of T steps at most; what was not measured, and the end of shorter ones, is NaN.

    Attributes:
        period: From step to step, s.
        begins: When the motions begin, s from the beginning of the recording, [B].
        start: Where the encoders said that the robot was, rad, [B, n].
        velocity: How fast it was, rad/s, [B, n]: zeros if it stood.
        before: The command until then, [B, n].
        command: In force from each step to the next, [T, B, n]; finite.
        measured: Positions, rad, velocities, rad/s, and efforts, N·m, after each of these steps, [3, T, B, n].
        noise: Standard deviations of these before the motions, [3, n]; of efforts 1 % of the largest.
        start_noise: Standard deviations of ``start``, which comes from few measurements, rad, [B, 1].
        left_out: Parts of the recording that could not be used, in words.
    """

    period: float
    begins: np.ndarray
    start: np.ndarray
    velocity: np.ndarray
    before: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    noise: np.ndarray
    start_noise: np.ndarray
    left_out: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.start)

    @property
    def held_out(self) -> np.ndarray:
        """Whether each motion is one by which a fit is judged, [B]: a quarter of them, spread over the recording.

        What shows only at high velocities and efforts, such as how strong a motor is, may show in one motion only. So
        they are chosen among those in which the fewest joints reach their largest velocity or effort.
        """
        sizes = np.where(np.isfinite(self.measured[1:]), np.abs(self.measured[1:]), 0.0).max(axis=1)  # [2, B, n]
        shown = sizes.max(axis=1) > 0.0
        largest = np.bincount(sizes.argmax(axis=1)[shown], minlength=len(self))
        count = max(1, len(self) // _HELD_OUT)
        others = np.flatnonzero(largest <= np.sort(largest)[count - 1])
        held_out = np.zeros(len(self), dtype=bool)
        held_out[others[((np.arange(count) + 0.5) * len(others) / count).astype(int)]] = True
        return held_out


def cut(recording: Recording, name: str, spec: RobotSpec) -> Trials:
    """Cut a recording wherever the robot has come to rest, or to a steady speed, as an arm that sinks.

    Args:
        recording: At least two motions, each after half a second with one command.
        name: Of the recording, for messages.
        spec: The robot as described: names and limits of its joints.

    Raises:
        UserError: If there are no two such motions, or a joint hardly moves in them.
    """
    joints = spec.joints
    motions, left_out = _motions(recording, spec)
    if len(motions) < _FEWEST:
        raise UserError(
            f"{name}: {len(motions)} motions begin at rest or at a steady speed, and at least {_FEWEST} are needed: "
            f"keep one command for {_STILL:g} s before each{''.join(f'; {each}' for each in left_out)}"
        )
    if len(motions) > _MOST:
        left_out.append(f"all but {_MOST} of {len(motions)} motions, spread over the whole time")
        motions = [motions[number] for number in np.linspace(0, len(motions) - 1, _MOST).round().astype(int)]
    degrees = sum(each.begin.degrees for each in motions)
    squares = np.sum([each.begin.squares for each in motions], axis=0)
    noise = np.tile(np.maximum(np.sqrt(squares / degrees), _LEAST_NOISE)[:, None], len(joints))
    start, velocity = (np.stack([getattr(each.begin, key) for each in motions]) for key in ("position", "velocity"))

    longest = max(each.last - each.first for each in motions)
    command = np.empty((longest, len(motions), len(joints)))
    measured = np.full((3, longest, len(motions), len(joints)), np.nan)
    for number, each in enumerate(motions):
        length = each.last - each.first
        command[:, number] = recording.command[each.last - 1]
        command[:length, number] = recording.command[each.first : each.last]
        measured[:2, :length, number] = _measured(recording)[:, each.first + 1 : each.last + 1]
        measured[2, :length, number] = recording.effort[each.first + 1 : each.last + 1]
    ways = np.nanmax(np.abs(measured[0] - start), axis=(0, 1))
    for joint, way in zip(joints, ways, strict=True):
        if not way > _LEAST_MOTION * noise[0, 0]:
            raise UserError(f"{name}: '{joint}' moves by {way:.2g} rad at most: too little to tell anything of it")
    begins = recording.period * np.array([each.first for each in motions])
    before = recording.command[[each.first - 1 for each in motions]]
    largest = np.nanmax(np.nan_to_num(np.abs(recording.effort)), axis=0)
    noise = np.concatenate([noise, [np.maximum(_LEAST_SHARE * largest, 1e-9)]])
    start_noise = noise[0, 0] * np.array([[each.begin.spread] for each in motions])
    return Trials(
        recording.period, begins, start, velocity, before, command, measured, noise, start_noise, tuple(left_out)
    )


@dataclass(frozen=True)
class _Motion:
    first: int  # step in which the command changes
    last: int  # the first step that does not belong to it
    begin: "_Begin"


@dataclass(frozen=True)
class _Begin:
    position: np.ndarray  # rad, [n]
    velocity: np.ndarray  # rad/s, [n]
    spread: float  # standard deviation of the position, as a multiple of the sensor's
    squares: np.ndarray  # sums of squared residuals of positions and velocities, means over the joints, [2]
    degrees: np.ndarray  # of freedom of these, [2]


def _motions(recording: Recording, spec: RobotSpec) -> tuple[list[_Motion], list[str]]:
    """Find the motions, and say what of the recording is left out."""
    known = np.isfinite(recording.command).all(axis=1)
    changed = np.ones(len(recording), dtype=bool)
    changed[1:] = ~(known[1:] & known[:-1]) | (recording.command[1:] != recording.command[:-1]).any(axis=1)
    changes = np.flatnonzero(changed)
    still, mean, longest, shortest = (
        round(seconds / recording.period) for seconds in (_STILL, _MEAN, _LONGEST, _SHORTEST)
    )
    begins = [int(step) for last, step in pairwise(changes) if step - last >= still and known[step]]
    motions, left_out = [], []
    for first, following in zip(begins, [*begins, len(recording) - 1][1:], strict=True):
        at = f"at {first * recording.period:.2f} s"
        last = min(following, first + longest)
        unknown = np.flatnonzero(~known[first:last])
        if len(unknown):
            last = first + int(unknown[0])
            left_out.append(f"{at}: no command is known from {last * recording.period:.2f} s on")
        free, joint = _free_of_limits(recording.position[first : last + 1], spec.position_limit)
        if joint is not None:
            last = max(first + free - 1, first)
            end = f"'{spec.joints[joint]}' comes to its limit at {(first + free) * recording.period:.2f} s"
            left_out.append(f"{at}: {end}, and nothing is used from there on")
        measured = _measured(recording)[:, first - mean + 1 : first + 1]
        known_at = np.isfinite(measured).all(axis=(0, 2))
        if last - first < shortest:
            left_out.append(f"{at}: too short")
        elif known_at.sum() < max(mean // 2, 4):
            left_out.append(f"{at}: too little was measured before it")
        else:
            begin = _begin(measured[:, known_at], recording.period * (np.flatnonzero(known_at) - mean + 1))
            if isinstance(begin, str):
                left_out.append(f"{at}: {begin}")
            else:
                motions.append(_Motion(first, last, begin))
    return motions, left_out


def _free_of_limits(position: np.ndarray, limits: np.ndarray) -> tuple[int, int | None]:
    """Return for how many steps of a motion no joint comes to a limit, and which one then does.

    What a limit does to a joint says nothing of the robot that is looked for. A joint that rests at its limit when the
    motion begins may leave it.

    Args:
        position: Of the joints, rad, [k, n].
        limits: Lower and upper ones, rad, [n, 2].
    """
    beyond = np.maximum(limits[:, 0] - position, position - limits[:, 1])
    near = beyond > -_NEAR_LIMIT
    comes = (near & np.logical_or.accumulate(~near & np.isfinite(position))) | (beyond > _BEYOND_LIMIT)
    steps = np.flatnonzero(comes.any(axis=1))
    return (int(steps[0]), int(comes[steps[0]].argmax())) if len(steps) else (len(position), None)


def _begin(measured: np.ndarray, time: np.ndarray) -> _Begin | str:
    """Say how a motion begins at time 0, or why that is not known.

    The two halves of what was measured of a robot that rests differ by no more than noise makes them. Those of one with
    a steady speed differ by the way that it makes at this speed, and its speed hardly changes.

    Args:
        measured: What was measured before, [2, k, n].
        time: When, [k].
    """
    half, count = len(time) // 2, len(time)
    first, second = measured[:, :half], measured[:, half : 2 * half]
    noise = np.sqrt((first.var(axis=1, ddof=1) + second.var(axis=1, ddof=1)) / half)  # of the difference of means
    change, speed = second.mean(axis=1) - first.mean(axis=1), measured[1].mean(axis=0)
    tolerance = np.maximum(_CREEPS * noise, _RESTING[:, None])
    if (np.abs(change[0]) <= tolerance[0]).all() and (np.abs(speed) <= tolerance[1]).all():
        squares = np.square(measured - measured.mean(axis=1, keepdims=True)).sum(axis=1).mean(axis=1)
        position, degrees = measured[0].mean(axis=0), np.full(2, count - 1.0)
        return _Begin(position, np.zeros_like(speed), count**-0.5, squares, degrees)
    between = time[half : 2 * half].mean() - time[:half].mean()
    noise[0] = np.hypot(noise[0], 0.5 * between * noise[1])  # of a way less that of the mean velocity
    tolerance = np.maximum(_CREEPS * noise, _RESTING[:, None]) + _STEADY * np.abs(speed) * np.array([[between], [1.0]])
    if (np.abs(change[1]) > tolerance[1]).any():
        return "its speed still changes when it begins"
    if (np.abs(change[0] - between * speed) > tolerance[0]).any():
        return "positions and velocities that were measured before it do not belong to each other"
    return _at_speed(measured, time)


def _at_speed(measured: np.ndarray, time: np.ndarray) -> _Begin:
    """Fit positions and velocities, weighted by their noise: position, velocity, and acceleration where that shows."""
    ones, zeros = np.ones_like(time), np.zeros_like(time)
    ways = np.stack([[ones, time, time**2 / 2], [zeros, ones, time]]).transpose(0, 2, 1)  # [2, k, 3]
    alone = [_residuals(ways[0], measured[0]), _residuals(ways[1][:, 1:], measured[1])]
    noise = [np.sqrt(np.square(left).sum() / left[0].size / (len(time) - 3 + at)) for at, left in enumerate(alone)]
    weight = 1.0 / np.maximum(noise, _LEAST_NOISE)
    rows, values = (np.concatenate(weight[:, None, None] * each) for each in (ways, measured))
    solve = np.linalg.pinv(rows)
    if (np.abs(solve[2] @ values) < _SHOWS * np.linalg.norm(solve[2])).all():
        ways, rows = ways[:, :, :2], rows[:, :2]
        solve = np.linalg.pinv(rows)
    found = solve @ values
    squares = np.square(measured - ways @ found).sum(axis=1).mean(axis=1)
    taken = np.einsum("ij,ji->i", rows, solve).reshape(2, -1).sum(axis=1)  # degrees that the fit has taken
    spread = float(np.linalg.norm(solve[0]) * weight[0])
    return _Begin(found[0], found[1], spread, squares, len(time) - taken)


def _residuals(ways: np.ndarray, values: np.ndarray) -> np.ndarray:
    left: np.ndarray = values - ways @ (np.linalg.pinv(ways) @ values)
    return left


def _measured(recording: Recording) -> np.ndarray:
    return np.stack([recording.position, recording.velocity])
