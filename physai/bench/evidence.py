"""What it is worth to know one's robot: policies trained in seven ways, on robots that differ from its description.

They learn in PyBullet, whose motors bring all joints to their velocities together; or in MuJoCo with drives, each of
which pulls at its own joint. The hidden robots live there, have drives and rotors, and respond late.
"""

import json
import shutil
import subprocess
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf
from rich.table import Table
from scipy import stats
from torch import Tensor

from physai.bench.hidden import draw, record, write_table
from physai.bench.identify import DRIVE, SECONDS, UNKNOWNS
from physai.bench.timing import config_of, table
from physai.compose import compose
from physai.envs.simulation import EnvConfig
from physai.errors import UserError
from physai.files import write_atomically
from physai.physics import ParameterLayout, RandomizationConfig
from physai.plots.stress import plot_maps
from physai.robots import RobotSpec
from physai.stress.axes import Axis
from physai.stress.run import Map, StressTest
from physai.stress.trial import ENOUGH
from physai.training.evaluation import Evaluation
from physai.training.run import FINAL_SEED, TrainedPolicy

ROBOTS, GOALS = 50, 20  # hidden robots, and goals for each of them
KNOWN, KNOWN_GOALS = 3, 200  # the first of them, which are recorded
NOMINAL_GOALS = 1000
AXES = Axis("link_mass", "scale", 0.2, 5.0), Axis("actuator_delay", "set", 0, 5)  # of the stress map
GRID, CELL = 6, 100
# The hidden robots have drives, and delays of up to a step more than in randomization=strong.
HIDDEN = (*DRIVE, "randomization=strong", "randomization.actuator_delay.low=2", "randomization.actuator_delay.high=4")
STRONG, DRIVES = ("randomization=strong",), "strong, drives"
WAYS = {
    "default": ("randomization=default",),
    "strong": STRONG,
    DRIVES: STRONG,
    "curriculum": (
        *("randomization=wide", "curriculum=adr"),
        *("curriculum.results=8", "curriculum.step=0.15", "curriculum.narrow_below=0.8"),
    ),
}
ADAPTIVE, TUNED, IDENTIFIED = "adaptive, drives", "adaptive, fine-tuned", "identified, drives"
DONE = "summary.json"  # which a run writes last


@dataclass(frozen=True)
class Arm:
    """How policies for an arm are trained, and what is not known of it.

    Attributes:
        taught: Overrides.
        learns: Those of students.
        tunes: Those of students that go on with PPO.
        rotor: What training with drives, and identification, take its rotors for; kg m².
        rotors: What the hidden ones have, at least and at most, kg m².
        feels: Whether its joints tell their efforts. It then need not bring motors to their limits to be known, and
            stays near home.
    """

    taught: tuple[str, ...]
    learns: tuple[str, ...]
    tunes: tuple[str, ...]
    rotor: float
    rotors: tuple[float, float]
    feels: bool

    @property
    def drives(self) -> tuple[str, ...]:
        """Overrides for training with drives, and for identification."""
        return (*DRIVE, f"env.robot.armature={self.rotor}") if self.rotor else DRIVE

    @property
    def unknowns(self) -> list[str]:
        """What is looked for in a recording; without weight or efforts, nothing tells where an encoder has its zero."""
        return [*UNKNOWNS, "armature", *(["encoder_offset"] if self.feels else [])]

    @property
    def hidden(self) -> tuple[str, ...]:
        """Overrides that draw hidden robots; one of which nothing is drawn has rotors from the middle of the range."""
        low, high = self.rotors
        drawn = f"{{distribution: uniform, low: {low}, high: {high}, operation: set}}"
        middle = f"env.robot.armature={(low + high) / 2}"
        return (*self.taught, *HIDDEN, middle, f"randomization.armature={drawn}")


ARMS = {
    "reacher": Arm(
        ("experiment=settle",),
        ("experiment=settle_student",),
        ("experiment=settle_finetune", "policy=gru"),
        0.0,
        (0.005, 0.02),
        feels=False,
    ),
    # MuJoCo Menagerie gives each joint of this arm a rotor of 0.1 kg m²; and the real one measures torques.
    "kuka7_reach": Arm(
        (),
        ("total_frames=600_000",),
        ("policy=gru", "total_frames=300_000", "evaluation.goals=1000"),
        0.1,
        (0.05, 0.2),
        feels=True,
    ),
}


class Fleet(RandomizationConfig):
    """Robots that were drawn before; the episodes are shared out evenly, those of one robot one after the other."""

    _robots: Tensor

    @classmethod
    def among(cls, draws: RandomizationConfig, robots: np.ndarray) -> "Fleet":
        """Take robots [R, P], which were drawn from ``draws``."""
        fleet = cls.model_validate(draws.model_dump())
        fleet._robots = torch.from_numpy(robots).float()
        return fleet

    def only(self, number: int) -> "Fleet":
        """Return a fleet of one of its robots."""
        return Fleet.among(self, self._robots[[number]].numpy())

    def sample(self, rows: int, layout: ParameterLayout, generator: torch.Generator) -> Tensor:  # noqa: D102
        return self._robots.repeat_interleave(-(-rows // len(self._robots)), dim=0)[:rows]


@dataclass(frozen=True)
class Judged:
    """What a policy does on a kind of robots.

    Attributes:
        success: Share of the goals, of each robot, [R].
        settled: Share of the goals that it stays at, [R].
        steps: Until the goal; one that is missed counts as all the steps of an episode, [R].
        change: Of the action from step to step, a mean of each robot, [R].
    """

    success: list[float]
    settled: list[float]
    steps: list[float]
    change: list[float]

    @classmethod
    def of(cls, found: Sequence[Evaluation], robots: int) -> "Judged":
        """Sort episodes by robot."""
        columns = ("success", "settled", "length", "action_change")
        values = [torch.cat([getattr(one, column).double() for one in found]) for column in columns]
        return cls(*(each.reshape(robots, -1).mean(dim=1).tolist() for each in values))


@dataclass(frozen=True)
class Shown:
    """All that is measured of a way to train, with one seed.

    Attributes:
        on: By the kind of robots.
        works: Share of the stress map in which 95 % settle.
    """

    on: dict[str, Judged]
    works: float


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return evidence_table(measure_evidence(options.seed, options.seeds, options.evidence_folder))


def measure_evidence(
    seed: int, seeds: int, folder: Path, arms: Sequence[str] = tuple(ARMS), overrides: Sequence[str] = ()
) -> dict[str, dict[str, list[Shown]]]:
    """Train, identify, and judge; policies that lie in the folder are not trained again.

    Returns:
        By arm and by way, what was found with each seed.
    """
    found: dict[str, dict[str, list[Shown]]] = {}
    for arm in arms:
        described = config_of(arm, seed, *ARMS[arm].taught, *overrides).env
        hidden = config_of(arm, seed, *ARMS[arm].hidden, *overrides)
        draws, spec = hidden.randomization, RobotSpec.from_config(hidden.env.robot)
        robots = np.concatenate([draw(draws, ParameterLayout(spec), seed + number) for number in range(ROBOTS)])
        recordings = [folder / f"{arm}_robot{number}.csv" for number in range(seed, seed + KNOWN)]
        folder.mkdir(parents=True, exist_ok=True)
        for number, path in enumerate(recordings, seed):
            feels = ARMS[arm].feels
            seen = record(hidden.env, draws, list(draws.draws), SECONDS, number, feels, near=feels).recording
            fresh = path.with_suffix(".new")
            write_table(seen, spec.joints, str(fresh))
            if path.is_file() and path.read_bytes() != fresh.read_bytes():
                shutil.rmtree(path.with_suffix(""), ignore_errors=True)  # found in another recording
            fresh.replace(path)
        found[arm] = {}
        for number in range(seed, seed + seeds):
            at, maps = folder / f"{arm}_seed{number}", {}
            for way, runs in _train_all(arm, number, recordings, at, overrides):
                shown, maps[way] = _judge(runs, described, hidden.env, Fleet.among(draws, robots))
                found[arm].setdefault(way, []).append(shown)
                settled = ", ".join(f"{np.mean(judged.settled):.1%} on {kind}" for kind, judged in shown.on.items())
                print(f"{arm}, {way}, seed {number}: settled {settled}; map {shown.works:.1%}", flush=True)
            plot_maps(maps, at / "stress.png")
            write_atomically(folder / "evidence.json", json.dumps(found, default=asdict, indent=2).encode())
    return found


def _train_all(
    arm: str, seed: int, recordings: Sequence[Path], folder: Path, overrides: Sequence[str]
) -> Iterator[tuple[str, list[Path]]]:
    """Train in each way, and say where the policies lie: one, or one for each robot that was recorded.

    Where a robot cannot be identified, a line says why, and the way is left out.
    """
    common = (f"env={arm}", f"seed={seed}", "export.formats=[]", "evaluation.in_a_row=0", *overrides)
    known = ARMS[arm]
    taught, learns, tunes = ((*common, *each) for each in (known.taught, known.learns, known.tunes))
    for way, changes in WAYS.items():
        drives = known.drives if way == DRIVES else ()
        yield way, [_train(folder / way.replace(", ", "_"), *taught, *changes, *drives)]
    among = (*STRONG, *known.drives)
    teacher = _train(folder / "teacher", *taught, *among, "policy=privileged")
    taught_by = "algo=distill", f"algo.teacher={teacher}"
    student = _train(folder / "adaptive", *learns, *among, *taught_by, after=teacher / DONE)
    yield ADAPTIVE, [student]
    yield TUNED, [_train(folder / "tuned", *tunes, *among, f"pretrained={student}", after=student / DONE)]
    own = []
    for recording in recordings:
        result = recording.with_suffix("") / "identified.yaml"
        if not result.is_file():
            told = f"data={recording}", f"env={arm}", f"fit=[{','.join(known.unknowns)}]", *known.drives
            try:
                _command("identify", *told, f"output={result.parent}")
            except UserError as error:
                print(f"{arm}, {IDENTIFIED}: left out: {error}", flush=True)
                return
        with_it = *taught, *known.drives, f"randomization={result}"
        own.append(_train(folder / recording.stem, *with_it, after=result))
    yield IDENTIFIED, own


def _train(folder: Path, *overrides: str, after: Path | None = None) -> Path:
    """Train, unless it was done with this config, and after what a run depends on was written."""
    said, done = folder / ".hydra" / "config.yaml", folder / DONE
    same = said.is_file() and done.is_file() and OmegaConf.load(said) == compose("train", overrides)
    if not same or (after is not None and done.stat().st_mtime < after.stat().st_mtime):
        shutil.rmtree(folder, ignore_errors=True)
        _command("train", *overrides, f"hydra.run.dir={folder}")
    return folder


def _command(module: str, *overrides: str) -> None:
    done = subprocess.run([sys.executable, "-m", f"physai.{module}", *overrides], capture_output=True, text=True)
    if done.returncode:
        raise UserError(f"physai.{module} {' '.join(overrides)}: {done.stderr.strip()[-200:]}")


def _judge(runs: Sequence[Path], described: EnvConfig, drives: EnvConfig, fleet: Fleet) -> tuple[Shown, Map]:
    """Judge one policy; or the first of several, and each on the robot that it was trained for."""

    def policy(randomization: RandomizationConfig, env: EnvConfig, number: int = 0) -> TrainedPolicy:
        return TrainedPolicy(runs[number % len(runs)], "best", randomization, env)

    nominal = policy(RandomizationConfig.none(), described).evaluate(NOMINAL_GOALS)
    hidden = policy(fleet, drives).evaluate(ROBOTS * GOALS)
    known = [policy(fleet.only(number), drives, number).evaluate(KNOWN_GOALS) for number in range(KNOWN)]
    on = {
        "the robot as described": Judged.of([nominal], 1),
        f"{ROBOTS} hidden robots": Judged.of([hidden], ROBOTS),
        f"{KNOWN} that were recorded": Judged.of(known, KNOWN),
    }
    with StressTest(policy(RandomizationConfig.none(), drives), CELL, FINAL_SEED) as test:
        found = test.map(*AXES, GRID)
    return Shown(on, float((found.settled >= ENOUGH * CELL).mean())), found


def evidence_table(found: dict[str, dict[str, list[Shown]]]) -> Table:
    """Show means over robots and seeds; of ``settled`` its 95 % interval (Student's t over robots), too."""
    columns = ("way", "success", "settled", "worst seed", "steps to goal", "change of action")
    shown = table("Policies by the way they were trained", "", *columns)
    for arm, ways in found.items():
        kinds = list(next(iter(ways.values()))[0].on)
        for kind in kinds:
            for number, (way, each) in enumerate(ways.items()):
                on = [one.on[kind] for one in each]
                settled = np.mean([one.settled for one in on], axis=0)
                shown.add_row(
                    "" if number else f"{arm}, {kind}",
                    way,
                    f"{100 * np.mean([one.success for one in on]):.1f} %",
                    f"{100 * settled.mean():.1f} %{_interval(100 * settled)}",
                    f"{100 * min(np.mean(one.settled) for one in on):.1f} %",
                    f"{np.mean([one.steps for one in on]):.1f}",
                    f"{np.mean([one.change for one in on]):.3f}",
                )
            shown.add_section()
        for number, (way, each) in enumerate(ways.items()):
            works = [one.works for one in each]
            name = "" if number else f"{arm}, share of the stress map in which 95 % settle"
            shown.add_row(name, way, "", f"{100 * np.mean(works):.0f} %", f"{100 * min(works):.0f} %", "", "")
        shown.add_section()
    return shown


def _interval(values: np.ndarray) -> str:
    if not values.std():
        return ""
    low, high = stats.t.interval(0.95, len(values) - 1, values.mean(), values.std(ddof=1) / len(values) ** 0.5)
    return f" ({max(low, 0.0):.1f} to {min(high, 100.0):.1f})"
