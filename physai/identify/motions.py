"""Motions that tell a robot's parameters apart: steps, chirps and slow sweeps around home, each after a rest."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physai.errors import UserError

_REST = 0.7  # s of zeros before each motion: an identification wants 0.5 s, and commands come early or late
_LONGEST = 3.9  # s; of a longer motion an identification takes the first 4 s
_STEPS, _CHIRP, _SWEEP = 1.8, 2.6, 2.6  # s, without the way back
_HELD = 0.15, 0.45  # s of one velocity; a command that stays for 0.5 s looks like the end of a motion
_FARTHEST = 0.5  # rad from home
_SLOW = 0.05  # rad/s, in sweeps
_LOWEST, _HIGHEST = 0.2, 3.0  # Hz, of chirps
_STOPPING = 0.4  # s that a joint may take to stop
_BACK = 4.0  # 1/s, how fast a motion goes back to where it began
_HOMING, _GAIN = 0.3, 2.0  # rad/s at most, and 1/s, between motions
_NEAR = 0.02  # rad from home, which counts as there
_BISECTIONS = 40


@dataclass(frozen=True)
class Bounds:
    """What motions of n joints keep.

    Attributes:
        position: Smallest and largest, rad, [n, 2]; infinite for joints that turn without end.
        margin: How far the joints stay from these, rad.
        velocity: Largest, rad/s, [n].
        acceleration: Largest change of a velocity, rad/s².
        home: Where motions begin, rad, [n].
    """

    position: np.ndarray
    margin: float
    velocity: np.ndarray
    acceleration: float
    home: np.ndarray

    @property
    def speed(self) -> np.ndarray:
        """Largest velocities from which the joints stop soon, rad/s, [n]."""
        return np.minimum(self.velocity, _STOPPING * self.acceleration)

    @property
    def reach(self) -> np.ndarray:
        """How far from home the joints may go, rad, [2, n]: down, which is negative or zero, and up."""
        # An arm is home where it is near; and one whose home is at a limit goes the other way.
        spare = self.margin + _NEAR
        room = self.position.T - self.home + np.array([[spare], [-spare]])
        down, up = np.clip(room, -_FARTHEST, _FARTHEST)
        return np.stack([np.minimum(down, 0.0), np.maximum(up, 0.0)])


@dataclass(frozen=True)
class Motion:
    """One motion: it begins at rest, at home, and ends at rest and, as far as time allows, where it began.

    Attributes:
        name: What it is, for people.
        velocity: Commands, rad/s, one a control step, [T, n]; the last ones are zeros.
    """

    name: str
    velocity: np.ndarray


def plan(bounds: Bounds, joints: Sequence[str], period: float, seconds: float, seed: int) -> list[Motion]:
    """Plan motions for a time: rounds of steps of each joint and of all, a chirp and a sweep, each in another order.

    Steps bring motors to their limits, if the bounds let them: masses show. Chirps go through the frequencies, and
    tell delay from gain. Sweeps are slow, and show friction.

    Args:
        bounds: What the robot may do.
        joints: Their names.
        period: Of the commands, s.
        seconds: How long the robot moves and rests in turns, if it follows; at least one motion is planned.
        seed: Draws them.

    Raises:
        UserError: If a joint's home is beyond its limits.
    """
    beyond = (bounds.home < bounds.position[:, 0]) | (bounds.home > bounds.position[:, 1])
    if beyond.any():
        raise UserError(f"'{joints[int(beyond.argmax())]}': its home is beyond its limits: motions begin there")
    random = np.random.default_rng(seed)
    motions: list[Motion] = []
    left = seconds - _REST
    everything = np.ones(len(joints), dtype=bool)
    while True:
        alone = [(f"steps of {joint}", np.array(joints) == joint) for joint in joints] if len(joints) > 1 else []
        kinds = [*alone, ("steps of all joints", everything), ("chirp", everything), ("slow sweep", everything)]
        for number in random.permutation(len(kinds)):
            name, moving = kinds[number]
            make = {"chirp": _chirp, "slow sweep": _sweep}.get(name, _steps)
            velocity = _kept(make(bounds, period, random) * moving, bounds, period)
            left -= len(velocity) * period + _REST
            if left < 0.0 and motions:
                return motions
            motions.append(Motion(name, velocity))


def _steps(bounds: Bounds, period: float, random: np.random.Generator) -> np.ndarray:
    """Velocities that jump, mostly to the other side, rad/s, [T, n]."""
    (down, up), speed = bounds.reach, bounds.speed
    velocity = np.zeros((round(_STEPS / period), len(speed)))
    for joint, fastest in enumerate(speed):
        step, at, sign = 0, 0.0, random.choice([-1.0, 1.0])
        while step < len(velocity) and up[joint] > down[joint]:
            level = sign * fastest * random.uniform(0.4, 1.0)
            room = (up[joint] - at if sign > 0 else at - down[joint]) / abs(level)
            held = max(2, round(min(random.uniform(*_HELD), room) / period))
            velocity[step : step + held, joint] = level
            step, at = step + held, at + level * held * period
            sign = sign if random.random() < 0.2 else -sign
    return velocity


def _chirp(bounds: Bounds, period: float, random: np.random.Generator) -> np.ndarray:
    """Sines from low to high frequencies, a little different for each joint, rad/s, [T, n]."""
    time = period * np.arange(round(_CHIRP / period))[:, None]
    low, high = _LOWEST, min(_HIGHEST, 0.125 / period)  # eight commands in the shortest wave
    frequency = low * (high / low) ** (time / _CHIRP) * random.uniform(0.8, 1.25, len(bounds.home))
    turning = 2 * np.pi * frequency
    # What a wave may be, by speed; by acceleration, where it is fast; and by its way to one side, where it is slow.
    widest = np.minimum(bounds.speed, bounds.acceleration / turning)
    amplitude = np.minimum(widest, 0.5 * np.abs(bounds.reach).max(axis=0) * turning)
    down, up = bounds.reach
    sign = np.where(up > -down, 1.0, np.where(up < -down, -1.0, random.choice([-1.0, 1.0], len(up))))
    wave: np.ndarray = sign * amplitude * np.sin(np.cumsum(turning * period, axis=0))
    return wave


def _sweep(bounds: Bounds, period: float, random: np.random.Generator) -> np.ndarray:
    """One slow wave there and back, rad/s, [T, n]: a velocity that stayed would look like a rest."""
    time = period * np.arange(round(_SWEEP / period))[:, None]
    (down, up), slow = bounds.reach, np.minimum(bounds.speed, _SLOW)
    sign = np.where(up > -down, 1.0, np.where(up < -down, -1.0, random.choice([-1.0, 1.0], len(up))))
    wave: np.ndarray = sign * slow * np.sin(2 * np.pi * time / _SWEEP)
    return wave


def _kept(wanted: np.ndarray, bounds: Bounds, period: float) -> np.ndarray:
    """Return the velocities nearest to these, [T, n], that keep the bounds; then the way back, and zeros."""
    change, speed = bounds.acceleration * period, bounds.speed
    last = round(_LONGEST / period) - int(np.ceil(speed.max() / change)) - 1  # from here on it brakes
    at, velocity = np.zeros_like(speed), np.zeros_like(speed)
    rows: list[np.ndarray] = []
    back = False
    while not back or velocity.any():
        step = len(rows)
        back = back or step >= last or (step >= len(wanted) and bool((np.abs(at) < 0.25 * _NEAR).all()))
        aim = np.zeros_like(speed) if back else wanted[step] if step < len(wanted) else -_BACK * at
        aim = np.clip(np.clip(aim, -speed, speed), velocity - change, velocity + change)
        velocity = _stopping_inside(aim, at, velocity, bounds.reach, change, period)
        at = at + velocity * period
        rows.append(velocity)
    return np.array(rows)


def _stopping_inside(
    aim: np.ndarray, at: np.ndarray, last: np.ndarray, reach: np.ndarray, change: float, period: float
) -> np.ndarray:
    """Return the velocities nearest to ``aim``, [n], from which joints ``at`` places still stop within their reach."""
    braking = last - np.clip(last, -change, change)

    def inside(velocity: np.ndarray) -> np.ndarray:
        steps = np.floor(np.abs(velocity) / change)  # until it stands, each slower by ``change``
        way = (steps + 1) * (np.abs(velocity) - 0.5 * change * steps) * np.sign(velocity) * period
        fits: np.ndarray = (at + way >= reach[0] - 1e-9) & (at + way <= reach[1] + 1e-9)
        return fits

    if inside(aim).all():
        return aim
    share, too_much = np.zeros_like(aim), np.ones_like(aim)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (share + too_much)
        fits = inside(braking + middle * (aim - braking))
        share, too_much = np.where(fits, middle, share), np.where(fits, too_much, middle)
    share = np.where(inside(aim), 1.0, share)
    return braking + share * (aim - braking)


class Excitation:
    """Goes through motions, one control step after another: home, a rest, a motion, home, a rest, a motion, ..., home.

    The way home is steered by where the robot is, so that what it does not follow exactly does not add up.

    Args:
        bounds: What the robot may do.
        motions: Of :func:`plan`.
        period: Of the commands, s.

    Attributes:
        motions: The same.
        period: The same.
        number: How many have been begun.
        broken_off: How many of them were.
    """

    def __init__(self, bounds: Bounds, motions: Sequence[Motion], period: float) -> None:
        self.motions, self.number, self.broken_off = motions, 0, 0
        self._bounds, self.period = bounds, period
        self._turns = np.isinf(bounds.position).all(axis=1)
        self._homing = np.minimum(0.5 * bounds.speed, _HOMING)
        self._rest = int(np.ceil(_REST / period))
        self._velocity = np.zeros_like(bounds.home)
        self._moves = self._stops = False  # in a motion; home, or almost
        self._step = 0  # of the motion, or of the rest

    @property
    def done(self) -> bool:
        """Whether all motions are over, and the robot has come home and rested."""
        return not self._moves and self.number == len(self.motions) and self._step >= self._rest

    def interrupt(self) -> None:
        """The robot stands, and not for this: what is left of a motion is left out."""
        self.broken_off += self._moves
        self._velocity = np.zeros_like(self._velocity)
        self._go_home()

    def step(self, position: np.ndarray) -> np.ndarray:
        """Return the velocities for the next control step, rad/s, [n], of a robot whose joints are there, rad, [n]."""
        if self._moves and self._step == len(self.motions[self.number - 1].velocity):
            self._go_home()
        if not self._moves and self._step >= self._rest and self.number < len(self.motions):
            self._moves, self._step, self.number = True, 0, self.number + 1
        if self._moves:
            self._velocity = self.motions[self.number - 1].velocity[self._step]
            self._step += 1
            return self._velocity
        away = self._away(position)
        self._stops = self._stops or bool((np.abs(away) < _NEAR).all())
        # Never quite the same, however far it is: a command that stays would look like a rest.
        aim = np.zeros_like(away) if self._stops else -self._homing * np.tanh(_GAIN * away / self._homing)
        change = self._bounds.acceleration * self.period
        self._velocity = self._velocity + np.clip(aim - self._velocity, -change, change)
        self._step += self._stops and not self._velocity.any()
        return self._velocity

    def left(self, position: np.ndarray) -> float:
        """Return how long it takes until all is done, s, if the robot follows."""
        if self.done:
            return 0.0
        steps = sum(len(motion.velocity) + self._rest for motion in self.motions[self.number :])
        if self._moves:
            steps += len(self.motions[self.number - 1].velocity) + self._rest - self._step
            return steps * self.period
        way = 0.0 if self._stops else float((np.abs(self._away(position)) / self._homing).max())
        return max(steps + self._rest - self._step, 1) * self.period + way

    def _go_home(self) -> None:
        self._moves, self._stops, self._step = False, False, 0

    def _away(self, position: np.ndarray) -> np.ndarray:
        """How far the joints are from home, rad, [n]; those that turn without end take the shorter way."""
        away = position - self._bounds.home
        wrapped: np.ndarray = np.where(self._turns, (away + np.pi) % (2 * np.pi) - np.pi, away)
        return wrapped


def simulate(excitation: Excitation, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all commands, rad/s, and where they lead a robot that follows exactly, rad, [T, n] each.

    Args:
        excitation: Is used up.
        position: Where the robot is in the beginning, rad, [n].
    """
    commands, positions = [], []
    while not excitation.done:
        commands.append(excitation.step(position))
        position = position + commands[-1] * excitation.period
        positions.append(position)
    return np.array(commands), np.array(positions)
