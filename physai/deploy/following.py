"""Whether the arm does what it is told: commanded motion against measured motion, over a moving window."""

import math
from typing import NamedTuple

import numpy as np

from physai.deploy.metadata import Metadata
from physai.deploy.parameters import ControllerConfig

# What healthy arms need, measured on simulated ones of randomization=strong (delays of 60 ms, gains of 0.3, encoder
# noise of 5 mrad), and with 50 ms of delay more: docs/faults.md, "An arm that does not follow".
_DELAY = 0.16  # s; measured motion may be that of commands up to so much older
_FLOOR = 0.015  # rad
_PROGRESS = 0.1  # tolerances
_DRAGGED = 0.5  # share of the fastest joint's motion that the others may be dragged along with, of following_error


class Deviation(NamedTuple):
    """What is wrong with a joint's motion.

    Attributes:
        consistent: Whether the robot's positions and velocities agree: then the arm does not follow. Else a sensor
            is wrong.
        text: A line for people.
    """

    consistent: bool
    text: str


class Following:
    """Compares what was commanded with how positions changed, and that with the velocities that the robot reports.

    All three are looked at on a grid of control periods, by the slope of a line through the window, which encoder
    noise moves least. The measured slope must lie among those of the commanded path at all delays up to 0.16 s, give
    or take ``following_error`` of it and 0.015 rad. Until a window is full, which takes as long as it, nothing is said.

    Args:
        metadata: Names of the joints, control rate.
        config: ``following_error``, ``following_window`` and ``velocity_error`` are used.
    """

    def __init__(self, metadata: Metadata, config: ControllerConfig) -> None:
        self._joints = metadata.joints
        self._period = 1.0 / metadata.control_rate
        window = max(2, round(config.following_window / self._period))
        lags = max(1, round(_DELAY / self._period))
        self._seconds = window * self._period
        self._share = config.following_error
        self._velocity_error = config.velocity_error * self._seconds
        # Weights that turn a window of a path into its slope times the window's length: how far it went.
        centered = np.arange(window + 1) - window / 2
        weights = centered * (window / (centered**2).sum())
        # Of velocities, what the same weights make of the path that they add up to.
        after = np.cumsum(weights[::-1])[::-1]
        self._weights = np.stack([weights, self._period * (after - 0.5 * weights)])
        self._lagged = np.zeros((lags + 1, window + lags + 1))
        for lag in range(lags + 1):
            self._lagged[-1 - lag, lag : lag + window + 1] = weights
        self._window, n = window, len(self._joints)
        # The newest row of a grid is the last one. Commands are known before the measurements that they lead to.
        ahead = math.ceil(config.state_timeout / self._period) + 4
        self._commanded = np.zeros((window + lags + 1 + ahead, n))
        self._measured = np.zeros((window + 1, 2 * n))  # positions, then velocities
        self._ahead = ahead
        self.restart()

    def restart(self) -> None:
        """Forget what was: the arm stood, or nobody knows what it did."""
        self._begun = False
        self._rows, self._sample_at = 0, -math.inf  # of measurements, and when the last of them was taken
        self._commanded[:] = 0.0

    def commanded(self, now: float, way: np.ndarray, rests: bool = False) -> None:
        """Take how far each joint was told to go, [n] rad, until a time, s, since the last such time.

        Of an arm that rests at its goal, what is measured is forgotten. What was commanded is not: a late arm moves on.
        """
        if rests:
            self._rows, self._sample_at = 0, -math.inf
        if not self._begun:
            self._begun = True
            self._start = self._at = now
            self._told = self._seen = 0  # the newest rows, in periods since the start
            self._path = np.zeros(len(self._joints))
            return
        while (at := self._start + (self._told + 1) * self._period) <= now:
            self._told += 1
            share = (at - self._at) / (now - self._at) if now > self._at else 1.0
            self._commanded[:-1] = self._commanded[1:]
            self._commanded[-1] = self._path + way * share
        self._path = self._path + way
        self._at = now

    def heard(self, received: float, motion: np.ndarray) -> Deviation | None:
        """Take what was measured at a time, s: positions, rad, and velocities, rad/s, [2 n]; say what is wrong."""
        if not self._begun or received < self._start or received <= self._sample_at:
            return None
        sample, passed = motion.copy(), received - self._sample_at
        if not self._rows:
            self._rows = 1
            self._seen = math.ceil((received - self._start) / self._period - 1e-9) - 1
            self._sample, passed = sample, 1.0
        rows = self._rows
        while self._seen < self._told and (at := self._start + (self._seen + 1) * self._period) <= received:
            share = (at - self._sample_at) / passed if self._sample_at > -math.inf else 1.0
            self._seen += 1
            self._measured[:-1] = self._measured[1:]
            self._measured[-1] = self._sample + (sample - self._sample) * share
            self._rows += 1
        self._sample, self._sample_at = sample, received
        if self._told - self._seen > self._ahead:
            self.restart()
            return None
        return self._judge() if self._rows > max(rows, self._window + 1) else None

    def _judge(self) -> Deviation | None:
        n = len(self._joints)
        went = self._weights @ self._measured
        moved, reported = went[0, :n], went[1, n:]
        last = len(self._commanded) - (self._told - self._seen)
        told = self._weights[0] @ self._commanded[last - self._window - 1 : last]
        # Most of the time all three agree, and no more needs to be asked.
        if np.abs(moved - told).max() < _FLOOR and np.abs(reported - moved).max() < self._velocity_error:
            return None
        told = self._lagged @ self._commanded[last - self._lagged.shape[1] : last]
        least, most = told.min(axis=0), told.max(axis=0)
        size = np.maximum(-least, most)
        allowed = _FLOOR + self._share * np.maximum(size, _DRAGGED * size.max())
        excess = np.maximum(least - moved, moved - most) - allowed
        if excess.max() > 0:
            joint = int(excess.argmax())
            far = least[joint] if abs(least[joint]) > abs(most[joint]) else most[joint]
            return Deviation(True, self._describe(joint, float(moved[joint]), float(far)))
        apart = np.abs(reported - moved) - self._velocity_error - 0.3 * np.maximum(np.abs(reported), np.abs(moved))
        if apart.max() > 0:
            joint = int(apart.argmax())
            text = (
                f"'{self._joints[joint]}' reports velocities for {reported[joint]:.3f} rad in {self._seconds:.2g} s, "
                f"and its position moved by {moved[joint]:.3f} rad"
            )
            return Deviation(False, text)
        return None

    def _describe(self, joint: int, moved: float, told: float) -> str:
        positions = self._measured[:, joint]
        if abs(told) <= abs(moved) and moved * told >= 0:
            how = "moves by itself" if abs(told) < _FLOOR else "moves too fast"
        elif moved * told < 0 and abs(moved) > _FLOOR:
            how = "moves the other way"
        elif (positions == positions[0]).all():
            how = "is stuck"
        else:
            how = "does not move" if abs(moved) < 0.2 * abs(told) else "moves too slowly"
        seconds = f"{self._seconds:.2g} s"
        return f"'{self._joints[joint]}' {how}: by {moved:.3f} rad in {seconds}, and was commanded {told:.3f} rad"


class Progress:
    """Whether the distance to a goal, in tolerances, still falls; a tenth of one counts as progress."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin anew: another goal, or one that was reached."""
        self._best, self._waited = math.inf, 0.0

    def waited(self, distance: float, elapsed: float) -> float:
        """Return for how long, s, the distance has not fallen, ``elapsed`` s after it was asked last."""
        if distance < self._best - _PROGRESS:
            self._best, self._waited = distance, 0.0
        else:
            self._waited += elapsed
        return self._waited


class Strain:
    """For how long the effort of a joint has been beyond its limit.

    Args:
        metadata: ``effort_limit``, N·m.
    """

    def __init__(self, metadata: Metadata) -> None:
        self._joints, self._limit = metadata.joints, metadata.effort_limit
        self._since = np.full(len(self._joints), np.inf)

    def restart(self) -> None:
        """Forget what was."""
        self._since[:] = np.inf

    def heard(self, received: float, effort: np.ndarray, longest: float) -> str | None:
        """Take efforts [n], N·m, of a time, s; say which joint is beyond its limit for longer than ``longest`` s."""
        beyond = np.abs(effort) > self._limit  # an unknown one, NaN, is not
        if not beyond.any():
            self._since[:] = np.inf
            return None
        self._since = np.where(beyond, np.minimum(self._since, received), np.inf)
        joint = int(self._since.argmin())
        if received - self._since[joint] < longest:
            return None
        return (
            f"'{self._joints[joint]}' takes {effort[joint]:.3g} N·m, beyond its {self._limit[joint]:.3g}, for "
            f"{received - self._since[joint]:.2f} s"
        )
