"""Find the robot whose motions are those that were recorded."""

import logging
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from physai.identify.predictor import Predictor
from physai.identify.trials import Trials
from physai.identify.unknowns import Unknowns

_STEP = 1e-3  # units, over which slopes are taken
_FIRST, _MORE, _LAST = 6, 15, 40  # evaluations from each start, from the best, and from the last ones
_STARTS = 3
_CLOSE = 2.0  # times the best cost, up to which the second best may yet become the best
_DOUBT = 3.0  # times the errors of most motions, beyond which an error counts by its size, and not by its square
_SPOILT = 3.0  # times the errors of most motions: one with more is left out,
_MOST_SPOILT = 0.34  # of the motions; if there were more, it is the model
_ROUNDS = 3
_ENOUGH = 1e-6  # of its size, by which the cost must yet fall: of a fit by thousands of positions, that tells nothing
_PART = 0.25  # of a step of the recording: how finely a delay is found
_OFF = 3.0  # standard deviations by which it may have begun elsewhere than measured
SHARE = 0.1  # of the largest in a direction, from which a parameter has a part in it
_TOLD = 0.3  # units; a parameter of which less is known cannot be told
_SLOPES = 0.025  # relative error that slopes from differences may have
_EXPLAINED = 1.5  # times the noise, up to which the errors of motions held out count as explained
SPREAD = 1.96  # standard deviations of a 95 % interval

Told = Callable[[str], None]


@dataclass(frozen=True)
class Fit:
    """What was found.

    Attributes:
        unknowns: What was looked for, F numbers.
        coordinates: What they are, [F].
        delay: Of the actuators, control steps, and parts of one.
        deviation: Standard deviations of the coordinates, [F]: sqrt of the diagonal of the inverse of JᵀJ + 1, where
            the 1 says that each is within some units of the description.
        alone: Standard deviation of each, if all the others were known, [F].
        told: Which of them the data tell, [F].
        together: Directions of unit length in which the data tell nothing, though each of their parameters shows,
            [K, F].
        unseen: Which of them show in no motion at all, [F].
        before: Root mean square error of positions in motions held out, as the description predicts them, rad, [n].
        after: The same of the fit, [n].
        held_out: Positions in the H motions held out: measured, as described, as found, rad,
            [3, T, H, n]; NaN where nothing was measured.
        sensor_noise: Standard deviations of positions, rad, and velocities, rad/s, [2].
        ratio: Root mean square of all errors held out, in units of the noise of the sensors.
        spoilt: Numbers of the motions that were left out, for they do not fit the others.
    """

    unknowns: Unknowns
    coordinates: np.ndarray
    delay: float
    deviation: np.ndarray
    alone: np.ndarray
    told: np.ndarray
    together: np.ndarray
    unseen: np.ndarray
    before: np.ndarray
    after: np.ndarray
    held_out: np.ndarray
    sensor_noise: np.ndarray
    ratio: float
    spoilt: tuple[int, ...]

    @property
    def explained(self) -> bool:
        """Whether what is left is what the sensors' noise explains."""
        return self.ratio < _EXPLAINED

    @property
    def values(self) -> np.ndarray:
        """What was found, SI units, [F]."""
        return self.unknowns.values(self.coordinates[None])[0]

    @property
    def interval(self) -> np.ndarray:
        """95 % intervals of the values, [2, F]."""
        ends = self.coordinates + SPREAD * np.array([[-1.0], [1.0]]) * self.deviation
        return self.unknowns.values(np.clip(ends, self.unknowns.low, self.unknowns.high))


@contextmanager
def _exploding_robots_unsaid() -> Iterator[None]:
    """A robot that is tried may be one that no engine can step: it fits badly, and that is all there is to tell."""
    log = logging.getLogger("physai.physics")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(before)


@_exploding_robots_unsaid()
def fit(predict: Predictor, trials: Trials, unknowns: Unknowns, longest: int, seed: int, told: Told) -> Fit:
    """Least squares from several starts, with delays about the best; bounded, by trust regions (``least_squares``).

    Errors far beyond those of most motions count less at first (Huber, 1964), and motions full of them are left out: a
    computer that was too late has spoilt them. Slopes come from one rollout in which each unknown is changed in a robot
    of its own. A quarter of the motions is held out; only where they began is found for them, as for the others.

    Args:
        predict: Of the trials.
        trials: What the robot did.
        unknowns: What to find.
        longest: Delay of the actuators that is tried, in control steps: up to it whole steps of the recording, and
            fractions of a step about the best.
        seed: Draws starts.
        told: Is told what goes on.
    """
    problem = _Problem(predict, trials, unknowns)
    delays = range(round(longest * predict.per_control_step) + 1)
    starts = np.zeros((_STARTS, len(unknowns) + trials.start.size))
    # From the robot as described; and with motors that can do no more than they did, for that may be all they can.
    shown, random = problem.as_strong_as_shown(), np.random.default_rng(seed)
    starts[1:, : len(shown)] = shown
    certain = 1 if np.allclose(shown, 0.0) else 2  # where no effort was recorded, the two are one
    starts[certain:, : len(shown)] += 0.7 * random.standard_normal((_STARTS - certain, len(shown)))
    found: list[tuple[OptimizeResult, float]] = []
    for number, start in enumerate(starts, 1):
        # Which delay it is shows before anything else is known.
        delay = min(delays, key=lambda delay: float(np.abs(problem.errors(problem.inside(start), delay)).sum()))
        found.append(problem.solve(start, delay, _FIRST))
        told(f"start {number} of {len(starts)}: {found[-1][0].cost:.4g}")
    best, at = min(found, key=_cost)

    def tried(begin: np.ndarray, delay: float) -> tuple[OptimizeResult, float]:
        solved = problem.solve(begin, delay, _FIRST)
        told(f"delay of {delay / predict.per_control_step:g} steps: {_cost(solved):.4g}")
        return solved

    for _ in range(_ROUNDS):
        problem.set_doubt(best, at)
        found = _downhill(at, delays, partial(tried, best.x), max(1, round(predict.per_control_step / 2)))
        result, at = min(found, key=_cost)
        best, at = problem.solve(result.x, at, _MORE)
        if not problem.leave_out(best, at):
            break
    others = [each for each in sorted(found, key=_cost)[:2] if each[1] != at and _cost(each) < _CLOSE * best.cost]
    finalists = [(best.x, at), *((result.x, delay) for result, delay in others)]
    limits = np.array([label.startswith("effort_limit") for label in unknowns.labels])
    if (best.x[: len(shown)][limits] > shown[limits]).any():  # one that is never reached may be too high
        lower = best.x.copy()
        lower[: len(shown)][limits] = np.minimum(lower[: len(shown)], shown)[limits]
        finalists.append((lower, at))
    problem.trust()
    best, at = min((problem.solve(begin, delay, _LAST) for begin, delay in finalists), key=_cost)
    whole = at
    for way in (-_PART, _PART):
        while at + way >= 0 and _cost(better := problem.solve(best.x, at + way, _FIRST)) < best.cost:
            best, at = better
            told(f"delay of {at / predict.per_control_step:g} steps: {best.cost:.4g}")
    if at != whole:
        best, at = problem.solve(best.x, at, _LAST)
    return problem.judge(best, at)


def _downhill(
    start: float, delays: Collection[float], solve: Callable[[float], tuple[OptimizeResult, float]], reach: int
) -> list[tuple[OptimizeResult, float]]:
    """Solve with a delay, and with those near it until none is better: costs rise on both sides of the right one."""
    best, found = start, {start: solve(start)}
    near = range(-reach, reach + 1)
    while untried := [at for way in near if (at := best + way) in delays and at not in found]:
        found |= {at: solve(at) for at in untried}
        best = min(found, key=lambda at: _cost(found[at]))
    return list(found.values())


def _cost(found: tuple[OptimizeResult, float]) -> float:
    return float(found[0].cost)


class _Problem:
    """Unknowns of the robot, then where each motion really began: F + B n coordinates.

    A mean of few noisy positions is not where a robot stood, and all that follows in a motion is off by as much. Taken
    as exact it would pass for what the parameters do, and intervals would be far too narrow.
    """

    def __init__(self, predict: Predictor, trials: Trials, unknowns: Unknowns) -> None:
        self._predict, self._trials, self._unknowns = predict, trials, unknowns
        measured = np.isfinite(trials.measured)
        self._fitted = measured & ~trials.held_out[:, None]
        self._held_out = measured[:2] & trials.held_out[:, None]
        self._noise = trials.noise[:, None, None, :]
        self._kept = np.ones(len(trials), dtype=bool)
        self._learned = np.flatnonzero(~trials.held_out)
        self._doubt = _DOUBT
        anywhere = np.full(trials.start.size, np.inf)
        self.low = np.concatenate([unknowns.low, -anywhere])
        self.high = np.concatenate([unknowns.high, anywhere])

    def as_strong_as_shown(self) -> np.ndarray:
        """Coordinates of a robot as described whose motors can do what they did, and no more, [F].

        From a limit that no motor of the prediction reaches, no slope leads to the one that the robot's motors reached.
        """
        described = self._unknowns.parameters(np.zeros((1, len(self._unknowns))))[0]
        effort = self._trials.measured[2]
        largest = np.where(np.isfinite(effort), np.abs(effort), 0.0).max(axis=(0, 1))
        limit = described[self._predict.effort_limit]  # a view
        limit[largest > 0.0] = largest[largest > 0.0]
        return self._unknowns.coordinates(described)

    def inside(self, coordinates: np.ndarray) -> np.ndarray:
        """Move them a little into their bounds, as scipy wants it."""
        margin = 1e-6
        return np.clip(coordinates, self.low + margin, self.high - margin)

    def _all(self, coordinates: np.ndarray, delay: float, motions: np.ndarray | None = None) -> np.ndarray:
        """Errors in units of the noise, [R, 3, T, B, n], of all motions or of those with these numbers."""
        size, trials = len(self._unknowns), self._trials
        motions = np.arange(len(trials)) if motions is None else motions
        start = trials.start + trials.start_noise * coordinates[:, size:].reshape(-1, *trials.start.shape)
        seen = self._predict(self._unknowns.parameters(coordinates[:, :size]), delay, start[:, motions], motions)
        return (seen - trials.measured[:, :, motions]) / self._noise

    def errors(self, coordinates: np.ndarray, delay: float) -> np.ndarray:
        """Errors of the motions that are fitted; then how far all is from what was believed, which counts as little."""
        errors = self._all(coordinates[None], delay, self._learned)[0]
        return np.concatenate([errors[self._fitted[:, :, self._learned]], coordinates])

    def slopes(self, coordinates: np.ndarray, delay: float) -> np.ndarray:
        """Of these errors, [errors, F + B n].

        Where a joint begins is changed in all motions at once, for none feels what is changed in another.
        """
        size, (trials, joints) = len(self._unknowns), self._trials.start.shape
        step = np.where(coordinates[:size] + _STEP <= self._unknowns.high, _STEP, -_STEP)
        changes = np.zeros((1 + size + joints, len(coordinates)))
        changes[1 : 1 + size, :size] = np.diag(step)
        changes[1 + size :, size:] = np.tile(np.eye(joints), trials)
        errors, fitted = self._all(coordinates + changes, delay, self._learned), self._fitted[:, :, self._learned]
        slopes = np.zeros((int(fitted.sum()), len(coordinates)))
        slopes[:, :size] = (errors[1 : 1 + size] - errors[0])[:, fitted].T / step
        for joint, change in enumerate(errors[1 + size :] - errors[0]):
            for number, trial in enumerate(self._learned):
                own = np.zeros_like(change)
                own[:, :, number] = change[:, :, number]
                slopes[:, size + trial * joints + joint] = own[fitted]
        return np.concatenate([slopes, np.eye(len(coordinates))])

    def _of_motions(self, result: OptimizeResult, delay: float) -> np.ndarray:
        """Root mean square errors of all motions, in units of the noise, [B]."""
        errors = np.where(np.isfinite(self._trials.measured[:2]), self._all(result.x[None], delay)[0, :2], np.nan)
        motions: np.ndarray = np.sqrt(np.nanmean(np.square(errors), axis=(0, 1, 3)))
        return motions

    def set_doubt(self, result: OptimizeResult, delay: float) -> None:
        """Say beyond which errors something other than noise and this model is at work, from those of most motions."""
        self._doubt = _DOUBT * max(1.0, float(np.median(self._of_motions(result, delay)[self._kept])))

    def trust(self) -> None:
        """Let all errors count by their squares from now on."""
        self._doubt = np.inf

    def leave_out(self, result: OptimizeResult, delay: float) -> bool:
        """Leave out motions whose errors are far beyond those of most; return whether there are any, and not many."""
        errors = self._of_motions(result, delay)
        kept = self._kept & (errors < _SPOILT * max(1.0, float(np.median(errors[self._kept]))))
        fitted, held_out = self._fitted & kept[:, None], self._held_out & kept[:, None]
        few = (~kept).sum() <= _MOST_SPOILT * len(kept) and fitted.any() and held_out.any()
        if (kept == self._kept).all() or not few:
            return False
        self._kept, self._fitted, self._held_out = kept, fitted, held_out
        self._learned = np.flatnonzero(kept & ~self._trials.held_out)
        return True

    def solve(self, start: np.ndarray, delay: float, evaluations: int) -> tuple[OptimizeResult, float]:
        """Go downhill from somewhere, with a given delay."""
        # Scipy's dogbox needs half as many evaluations, but of one robot in twenty it finds another one.
        options: dict[str, Any] = {"bounds": (self.low, self.high), "x_scale": "jac", "max_nfev": evaluations}
        options |= {"ftol": _ENOUGH, "xtol": None, "gtol": None}
        if np.isfinite(self._doubt):
            options |= {"loss": "huber", "f_scale": self._doubt}
        return least_squares(self.errors, self.inside(start), self.slopes, args=(delay,), **options), delay

    def _begun(self, coordinates: np.ndarray, delay: float) -> np.ndarray:
        """Find where the motions held out began, too, with the robot as it is; two steps of Gauss and Newton.

        A mean of few noisy positions says it only roughly. No motion is moved by more than such a mean may be off: what
        the robot does not explain is not to be explained by that.
        """
        size, joints = len(self._unknowns), self._trials.start.shape[1]
        coordinates, changes = coordinates.copy(), np.zeros((1 + joints, len(coordinates)))
        starts = coordinates[size:].reshape(-1, joints)  # a view
        changes[1:, size:] = np.tile(np.eye(joints), len(starts))
        for _ in range(2):
            errors = self._all(coordinates + changes, delay)[:, :2]
            for trial in np.flatnonzero(self._held_out.any(axis=(0, 1, 3))):
                shown = self._held_out[:, :, trial]
                now, *changed = errors[:, :, :, trial][:, shown]
                slopes = np.stack(changed, axis=1) - now[:, None]
                away = slopes.T @ now + starts[trial]
                starts[trial] -= np.linalg.solve(slopes.T @ slopes + np.eye(joints), away)
            np.clip(starts, -_OFF, _OFF, out=starts)
        return coordinates

    def judge(self, result: OptimizeResult, delay: float) -> Fit:
        """Say what is known by now."""
        size = len(self._unknowns)
        described, found = (
            self._all(self._begun(at, late)[None], late)[0, :2]
            for at, late in ((np.zeros_like(result.x), 0.0), (result.x, delay))
        )
        ratio = float(np.sqrt(np.square(found[self._held_out]).mean()))
        squares = np.where(self._held_out, np.square(np.stack([described, found])), np.nan)[:, 0]
        before, after = self._trials.noise[0] * np.sqrt(np.nanmean(squares, axis=(1, 2)))
        slopes = self.slopes(result.x, delay)[: -len(result.x)] / max(ratio, 1.0)
        shows = np.square(slopes[:, :size]).sum(axis=0)
        covariance = np.linalg.inv(slopes.T @ slopes + np.eye(len(result.x)))[:size, :size]
        information = np.linalg.inv(covariance)
        alone = 1.0 / np.sqrt(np.diag(information))
        # What is left where slopes nearly cancel may be their own error; of a prior of one unit, all is certain.
        values, directions = np.linalg.eigh(information - np.diag(np.square(_SLOPES / alone)))
        covariance = (directions / np.maximum(values, 1.0)) @ directions.T
        deviation = np.sqrt(np.diag(covariance))
        unseen = shows < 1.0 / _TOLD**2
        # Along these directions a change of some units is lost in the noise.
        values, directions = np.linalg.eigh(covariance[~unseen][:, ~unseen])
        together = np.zeros((int((values > _TOLD**2).sum()), size))
        together[:, ~unseen] = directions[:, values > _TOLD**2].T
        shares = np.abs(together) > SHARE * np.abs(together).max(axis=1, keepdims=True)
        told = (deviation < _TOLD) & ~shares.any(axis=0)
        return Fit(
            self._unknowns, result.x[:size], delay / self._predict.per_control_step, deviation, alone, told,
            together, unseen, before, after, self._motions(described, found), self._trials.noise[:2, 0], ratio,
            tuple(np.flatnonzero(~self._kept).tolist()),
        )  # fmt: skip

    def _motions(self, *errors: np.ndarray) -> np.ndarray:
        """Positions in the motions held out, as measured and as predicted with these errors [2, T, B, n]."""
        measured, kept = self._trials.measured[0], self._held_out[0].any(axis=(0, 2))
        predicted = [each[0] * self._trials.noise[0] + measured for each in errors]
        return np.stack([measured, *predicted])[:, :, kept]
