"""What identifications find of robots whose parameters nobody is told."""

import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from physai.bench.hidden import NOISE, Hidden, record
from physai.bench.timing import config_of, table
from physai.compose import cores
from physai.envs.simulation import EnvConfig
from physai.identify.fit import Fit, fit
from physai.identify.predictor import Predictor
from physai.identify.trials import cut
from physai.identify.unknowns import Unknowns
from physai.physics import ParameterLayout
from physai.robots import RobotSpec

ROBOTS, DRIVES = 20, 6  # of which a fit takes several times as long
SECONDS = 30.0
DELAYS = 4
UNKNOWNS = ["link_mass", "payload", "joint_damping", "joint_friction", "velocity_gain"]
WITH_EFFORTS = [*UNKNOWNS, "effort_limit"]
ENGINE = "physics=mujoco"
PYBULLET = ("physics=pybullet",)
DRIVE = (ENGINE, "physics.motor=servo")
ROTORS = (*DRIVE, "env.robot.armature=0.01")
CASES = {  # how many, what they are, what they are taken for, what is looked for, and whether they tell efforts
    "MuJoCo in MuJoCo": (ROBOTS, (ENGINE,), (ENGINE,), UNKNOWNS, False),
    "the same, efforts": (ROBOTS, (ENGINE,), (ENGINE,), WITH_EFFORTS, True),
    "PyBullet in MuJoCo": (ROBOTS, PYBULLET, (ENGINE,), UNKNOWNS, False),
    "drives as PyBullet's motors": (ROBOTS, ROTORS, (ENGINE,), UNKNOWNS, False),
    "drives as drives without rotors": (DRIVES, ROTORS, DRIVE, UNKNOWNS, False),
    "drives, rotors looked for": (DRIVES, ROTORS, DRIVE, [*UNKNOWNS, "armature"], False),
}


@dataclass(frozen=True)
class Found:
    """A robot, and what was found of it.

    Attributes:
        hidden: The robot.
        fit: What was found.
        seconds: How long that took.
    """

    hidden: Hidden
    fit: Fit
    seconds: float

    @property
    def truth(self) -> np.ndarray:
        """What the unknowns are, [F]."""
        return self.hidden.parameters[self.fit.unknowns.columns]

    @property
    def held(self) -> np.ndarray:
        """Of those that are told, which 95 % intervals hold the truth."""
        low, high = self.fit.interval
        held: np.ndarray = ((low <= self.truth) & (self.truth <= high))[self.fit.told]
        return held

    def off(self, name: str, relative: bool) -> list[float]:
        """How far those of a name that are told are off, in parts of the truth or in their unit."""
        rows = np.array([label.startswith(name) for label in self.fit.unknowns.labels]) & self.fit.told
        off = np.abs(self.fit.values - self.truth)
        return list((off / self.truth if relative else off)[rows])

    @property
    def noise(self) -> float:
        """Errors of positions held out, in units of the noise; of the worst joint."""
        return float(self.fit.after.max() / NOISE[0])

    @property
    def better(self) -> float:
        """By how much these errors are smaller than those of the description; of all joints."""
        return float(np.sqrt(np.square(self.fit.before).mean() / np.square(self.fit.after).mean()))


def identify(hidden: Hidden, config: EnvConfig, names: list[str]) -> Found:
    """Find a robot again.

    Args:
        hidden: The robot.
        config: The env: what the robot is taken for, and the engine to find it in.
        names: What is looked for.
    """
    started = time.perf_counter()
    trials = cut(hidden.recording, "robot", hidden.spec)
    spec = RobotSpec.from_config(config.robot)
    unknowns = Unknowns.of(names, spec, ParameterLayout(spec))
    physics = config.physics | {"threads": cores()}
    with closing(Predictor(spec, physics, hidden.recording.period, trials)) as predict:
        found = fit(predict, trials, unknowns, DELAYS, 0, lambda _: None)
    return Found(hidden, found, time.perf_counter() - started)


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return identify_table(measure_identify(options.seed))


def measure_identify(seed: int, robots: int = ROBOTS, seconds: float = SECONDS) -> dict[str, list[Found]]:
    """Draw robots from ``randomization=strong``, and find them: in the engine that they live in, and in another."""
    found: dict[str, list[Found]] = {}
    for case, (most, real, taken_for, names, feels) in CASES.items():
        config = config_of("reacher", seed, "randomization=strong", *real)
        ours = config_of("reacher", seed, *taken_for).env
        drawn = WITH_EFFORTS if feels else UNKNOWNS
        found[case] = []
        for number in range(min(robots, most)):
            hidden = record(config.env, config.randomization, drawn, seconds, seed + number, feels)
            one = identify(hidden, ours, names)
            found[case].append(one)
            print(
                f"{case}, robot {number}: delay {one.fit.delay:g} of {hidden.delay}, {one.held.sum()} of "
                f"{len(one.held)} intervals, {one.noise:.2f} times the noise, {one.better:.1f} times better, "
                f"{one.seconds:.1f} s",
                flush=True,
            )
    return found


def identify_table(found: dict[str, list[Found]]) -> Table:
    """Show it: medians, and in brackets the worst."""
    found_of_each = ("link mass", "payload", "gain", "effort", "rotor")
    columns = ("robots", "delays", "intervals", "explained", *found_of_each, "held out", "better", "time")
    shown = table(f"{SECONDS:.0f} s of each hidden two-link arm: median (worst)", "", *columns)
    for case, each in found.items():
        held = np.concatenate([one.held for one in each])
        shown.add_row(
            case,
            str(len(each)),
            f"{sum(one.fit.delay == one.hidden.delay for one in each)} of {len(each)}",
            f"{held.sum()} of {len(held)}",
            f"{sum(one.fit.explained for one in each)} of {len(each)}",
            _spread([100 * off for one in each for off in one.off("link_mass", True)], "{:.1f} %"),
            _spread([1000 * off for one in each for off in one.off("payload", False)], "{:.0f} g"),
            _spread([100 * off for one in each for off in one.off("velocity_gain", True)], "{:.2f} %"),
            _spread([100 * off for one in each for off in one.off("effort_limit", True)], "{:.1f} %"),
            _spread([100 * off for one in each for off in one.off("armature", True)], "{:.1f} %"),
            _spread([one.noise for one in each], "{:.2f}"),
            _spread([one.better for one in each], "{:.1f}", worst=min),
            _spread([one.seconds for one in each], "{:.1f} s"),
        )
    return shown


def _spread(values: list[float], form: str, worst: Callable[[list[float]], float] = max) -> str:
    return f"{form.format(np.median(values))} ({form.format(worst(values))})" if values else "-"
