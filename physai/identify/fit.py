"""Find the robot whose motions are those that were recorded."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from physai.identify.trials import Trials
from physai.identify.unknowns import Unknowns
from physai.physics import ParameterLayout, Physics, RobotState
from physai.robots import RobotSpec
from physai.targets import make

_STEP = 1e-3  # units, over which slopes are taken
_FIRST, _LAST = 6, 40  # evaluations from each start, and from the best two
_STARTS = 3
_EVERY = 4  # of the motions, one is held out
_TOLD = 0.3  # units; a parameter of which less is known cannot be told
_EXPLAINED = 1.5  # times the noise, up to which the errors of motions held out count as explained
SPREAD = 1.96  # standard deviations of a 95 % interval

Told = Callable[[str], None]


@dataclass(frozen=True)
class Fit:
    """What was found.

    Attributes:
        unknowns: What was looked for, F numbers.
        coordinates: What they are, [F].
        delay: Of the actuators, control steps.
        deviation: Standard deviations of the coordinates, [F]: sqrt of the diagonal of the inverse of JᵀJ + 1, where
            the 1 says that each is within some units of the description.
        told: Which of them the data tell, [F].
        together: Directions of unit length in which the data tell nothing, though each of their parameters shows,
            [K, F].
        unseen: Which of them show in no motion at all, [F].
        before: Root mean square error of positions in motions held out, as the description predicts them, rad, [n].
        after: The same of the fit, [n].
        noise: Of positions, rad.
        ratio: Root mean square of all errors held out, in units of the noise of the sensors.
    """

    unknowns: Unknowns
    coordinates: np.ndarray
    delay: int
    deviation: np.ndarray
    told: np.ndarray
    together: np.ndarray
    unseen: np.ndarray
    before: np.ndarray
    after: np.ndarray
    noise: float
    ratio: float

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


class Predictor:
    """Lets robots with other parameters do what a real one did.

    Args:
        spec: The robot.
        physics: The engine, as ``conf/physics`` names one.
        control_dt: s.
        trials: What it did, B motions.
    """

    def __init__(self, spec: RobotSpec, physics: dict[str, Any], control_dt: float, trials: Trials) -> None:
        self._spec, self._config, self._control_dt, self._trials = spec, physics, control_dt, trials
        self._layout = ParameterLayout(spec)
        self._made: dict[int, Physics] = {}

    def __call__(self, parameters: np.ndarray, delay: int, start: np.ndarray) -> np.ndarray:
        """Map ``physics_parameters`` [R, P] to what encoders would have said, [R, 2, T, B, n].

        Args:
            parameters: Of R robots, each of which makes all the motions.
            delay: Of their actuators, control steps.
            start: What the encoders say when the motions begin, rad, [R, B, n].
        """
        trials, rows = self._trials, len(parameters)
        robots, joints = rows * len(trials), trials.start.shape[1]
        if robots not in self._made:
            needs = ("reset", "step", "close")
            made: Physics = make("physics", self._config, self._spec, robots, self._control_dt, needs=needs)
            self._made[robots] = made
        physics = self._made[robots]
        each = np.repeat(parameters, len(trials), axis=0)
        offset = each[:, self._layout.columns["encoder_offset"]]
        true = start.reshape(robots, joints) - offset
        physics.reset(np.arange(robots), RobotState(true, np.zeros_like(true)), self._layout.dynamics(each))
        arrives = np.concatenate([np.repeat(trials.before[None], delay, axis=0), trials.command])
        seen = np.empty((len(trials.command), 2, robots, joints))
        for step, now in enumerate(seen):
            state = physics.step(np.tile(arrives[step], (rows, 1)))
            now[0], now[1] = state.joint_position + offset, state.joint_velocity
        return seen.reshape(len(seen), 2, rows, len(trials), joints).transpose(2, 1, 0, 3, 4)

    def close(self) -> None:
        """Free the engines."""
        for physics in self._made.values():
            physics.close()


def fit(predict: Predictor, trials: Trials, unknowns: Unknowns, delays: range, seed: int, told: Told) -> Fit:
    """Least squares from several starts, with each delay; bounded, by trust regions (scipy's ``least_squares``).

    Slopes come from one rollout in which each unknown is changed in a robot of its own. Every fourth motion is held
    out.

    Args:
        predict: Of the trials.
        trials: What the robot did.
        unknowns: What to find.
        delays: Of the actuators, in control steps: all are tried.
        seed: Draws starts.
        told: Is told what goes on.
    """
    problem = _Problem(predict, trials, unknowns)
    starts = np.zeros((_STARTS, len(unknowns) + trials.start.size))
    starts[1:, : len(unknowns)] = 0.7 * np.random.default_rng(seed).standard_normal((_STARTS - 1, len(unknowns)))
    found: list[tuple[OptimizeResult, int]] = []
    for number, start in enumerate(starts, 1):
        # Which delay it is shows before anything else is known.
        delay = min(delays, key=lambda delay: float(np.square(problem.errors(problem.inside(start), delay)).sum()))
        found.append(problem.solve(start, delay, _FIRST))
        told(f"start {number} of {len(starts)}: {found[-1][0].cost:.4g}")
    best, at = min(found, key=lambda each: float(each[0].cost))
    for delay in delays:
        if delay != at:
            found.append(problem.solve(best.x, delay, _FIRST))
            told(f"delay of {delay} steps: {found[-1][0].cost:.4g}")
    finalists = sorted(found, key=lambda each: float(each[0].cost))[:2]
    last = [problem.solve(result.x, delay, _LAST) for result, delay in finalists]
    result, delay = min(last, key=lambda each: float(each[0].cost))
    told(f"best: {result.cost:.4g}, delay of {delay} steps")
    return problem.judge(result, delay)


class _Problem:
    """Unknowns of the robot, then where each motion really began: F + B n coordinates.

    A mean of few noisy positions is not where a robot stood, and all that follows in a motion is off by as much. Taken
    as exact it would pass for what the parameters do, and intervals would be far too narrow.
    """

    def __init__(self, predict: Predictor, trials: Trials, unknowns: Unknowns) -> None:
        self._predict, self._trials, self._unknowns = predict, trials, unknowns
        every = min(_EVERY, len(trials))
        held_out = np.arange(len(trials)) % every == every - 1
        measured = np.isfinite(trials.measured)
        self._fitted = measured & ~held_out[:, None]
        self._held_out = measured & held_out[:, None]
        self._noise = trials.noise[:, None, None, None]
        anywhere = np.full(trials.start.size, np.inf)
        self.low = np.concatenate([unknowns.low, -anywhere])
        self.high = np.concatenate([unknowns.high, anywhere])

    def inside(self, coordinates: np.ndarray) -> np.ndarray:
        """Move them a little into their bounds, as scipy wants it."""
        margin = 1e-6
        return np.clip(coordinates, self.low + margin, self.high - margin)

    def _all(self, coordinates: np.ndarray, delay: int) -> np.ndarray:
        """Errors in units of the noise, [R, 2, T, B, n]."""
        size, trials = len(self._unknowns), self._trials
        start = trials.start + trials.start_noise * coordinates[:, size:].reshape(-1, *trials.start.shape)
        seen = self._predict(self._unknowns.parameters(coordinates[:, :size]), delay, start)
        return (seen - trials.measured) / self._noise

    def errors(self, coordinates: np.ndarray, delay: int) -> np.ndarray:
        """Errors of the motions that are fitted; then how far all is from what was believed, which counts as little."""
        errors = self._all(coordinates[None], delay)[0]
        return np.concatenate([errors[self._fitted], coordinates])

    def slopes(self, coordinates: np.ndarray, delay: int) -> np.ndarray:
        """Of these errors, [errors, F + B n].

        Where a joint begins is changed in all motions at once, for none feels what is changed in another.
        """
        size, (trials, joints) = len(self._unknowns), self._trials.start.shape
        step = np.where(coordinates[:size] + _STEP <= self._unknowns.high, _STEP, -_STEP)
        changes = np.zeros((1 + size + joints, len(coordinates)))
        changes[1 : 1 + size, :size] = np.diag(step)
        changes[1 + size :, size:] = np.tile(np.eye(joints), trials)
        errors = self._all(coordinates + changes, delay)
        slopes = np.zeros((int(self._fitted.sum()), len(coordinates)))
        slopes[:, :size] = (errors[1 : 1 + size] - errors[0])[:, self._fitted].T / step
        for joint, change in enumerate(errors[1 + size :] - errors[0]):
            for trial in range(trials):
                own = np.zeros_like(change)
                own[:, :, trial] = change[:, :, trial]
                slopes[:, size + trial * joints + joint] = own[self._fitted]
        return np.concatenate([slopes, np.eye(len(coordinates))])

    def solve(self, start: np.ndarray, delay: int, evaluations: int) -> tuple[OptimizeResult, int]:
        """Go downhill from somewhere, with a given delay."""
        options: dict[str, Any] = {"bounds": (self.low, self.high), "x_scale": "jac", "max_nfev": evaluations}
        return least_squares(self.errors, self.inside(start), self.slopes, args=(delay,), **options), delay

    def judge(self, result: OptimizeResult, delay: int) -> Fit:
        """Say what is known by now."""
        size = len(self._unknowns)
        errors = self._all(np.stack([np.zeros_like(result.x), result.x]), delay)
        ratio = float(np.sqrt(np.square(errors[1][self._held_out]).mean()))
        squares = np.where(self._held_out, np.square(errors), np.nan)[:, 0]
        before, after = self._trials.noise[0] * np.sqrt(np.nanmean(squares, axis=(1, 2)))
        slopes = self.slopes(result.x, delay)[: -len(result.x)] / max(ratio, 1.0)
        shows = np.square(slopes[:, :size]).sum(axis=0)
        covariance = np.linalg.inv(slopes.T @ slopes + np.eye(len(result.x)))[:size, :size]
        deviation = np.sqrt(np.diag(covariance))
        unseen = shows < 1.0 / _TOLD**2
        # Along these directions a change of some units is lost in the noise.
        values, directions = np.linalg.eigh(covariance[~unseen][:, ~unseen])
        together = np.zeros((int((values > _TOLD**2).sum()), size))
        together[:, ~unseen] = directions[:, values > _TOLD**2].T
        return Fit(
            self._unknowns, result.x[:size], delay, deviation, deviation < _TOLD, together, unseen, before, after,
            float(self._trials.noise[0]), ratio,
        )  # fmt: skip
