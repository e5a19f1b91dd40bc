"""How soon a policy is trained, against Stable-Baselines3, rsl_rl and SBX."""

import math
import multiprocessing
import os
import signal
from argparse import Namespace
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from rich.table import Table
from tensordict.nn import TensorDictModule

from physai.bench.learner import Learner, Settings, fastest_threads
from physai.bench.timing import reacher, table, timed
from physai.envs.make import TransformedRobotEnv
from physai.seeding import derive
from physai.training.agent import Agent, make_evaluation_env
from physai.training.config import TrainConfig
from physai.training.evaluation import evaluate

TARGET = 0.99
GOALS = 1000
GOALS_SEED = derive(0, "benchmark goals")  # the same for all, unseen in training
FAST_ENGINE = ("physics=mujoco", f"physics.threads={os.cpu_count()}")  # PyBullet would judge for most of the time
JUDGE_EVERY = 4096  # frames, or
JUDGE_AFTER = 5.0  # s of learning, whichever comes first; and no sooner than
JUDGE_SHARE = 1 / 16  # of those so far: slow learners would spend their time on being judged


@dataclass
class Race:
    """How a learner fared; its clock counts learning alone, not building and not judging."""

    name: str
    target: float = TARGET
    frames: int = 0
    seconds: float = 0.0
    success_rate: float = 0.0

    @property
    def frames_per_second(self) -> float:
        """Speed."""
        return self.frames / self.seconds

    @property
    def won(self) -> bool:
        """Whether the target was reached."""
        return self.success_rate >= self.target


def run_race(
    race: Race,
    learn: Callable[[], int],
    evaluator: Callable[[], float],
    max_frames: float = math.inf,
    max_seconds: float = math.inf,
) -> Race:
    """Learn until an evaluation finds the target reached, or until it takes too long; return the race.

    Args:
        race: At its start.
        learn: One iteration of collecting and learning; returns its frames.
        evaluator: Returns the success rate of the policy as it is.
        max_frames: Where to give up.
        max_seconds: When to give up.
    """
    while not race.won and race.frames < max_frames and race.seconds < max_seconds:
        due = min(race.frames + max(JUDGE_EVERY, JUDGE_SHARE * race.frames), max_frames)
        late = min(race.seconds + max(JUDGE_AFTER, JUDGE_SHARE * race.seconds), max_seconds)
        while race.frames < due and race.seconds < late:
            frames, seconds = timed(learn)
            race.frames += frames
            race.seconds += seconds
        race.success_rate = evaluator()
        print(
            f"{race.name}: {race.frames:>9,} frames  {race.seconds:6.1f} s  {race.frames_per_second:>6,.0f}/s  "
            f"success {race.success_rate:6.1%}",
            flush=True,
        )
    return race


OURS = {
    "physai": (),
    "physai, physics=mujoco": ("physics=mujoco",),
    "physai, collector=single": ("collector=single",),
}
# By name, a package, a module here and its settings; a process imports only the libraries that race in it.
PEERS = {
    "SB3, tuned, physai's features": ("stable_baselines3", "sb3", "TUNED_WITH_FEATURES"),
    "SB3, tuned": ("stable_baselines3", "sb3", "TUNED"),
    "SB3, defaults": ("stable_baselines3", "sb3", "DEFAULTS"),
    "rsl_rl, tuned, physai's features": ("rsl_rl", "rsl_rl", "TUNED_WITH_FEATURES"),
    "rsl_rl, tuned": ("rsl_rl", "rsl_rl", "TUNED"),
    "rsl_rl, Isaac Lab's settings": ("rsl_rl", "rsl_rl", "ISAAC_LAB"),
    "SBX, tuned, physai's features": ("sbx", "sbx", "TUNED_WITH_FEATURES"),
    "SBX, tuned": ("sbx", "sbx", "TUNED"),
}


@dataclass(frozen=True)
class Conditions:
    """What all races have in common.

    Attributes:
        peer_seconds: When a peer gives up; one whose learning rate falls also does so at its end.
        goals: How many each evaluation has.
        overrides: Of the config of the robots and of physai.
    """

    peer_seconds: float
    goals: int = GOALS
    overrides: tuple[str, ...] = ()


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return training_table(measure_training(options.seed, options.seeds, Conditions(options.peer_seconds)))


def measure_training(seed: int, seeds: int, conditions: Conditions) -> dict[str, list[Race]]:
    """Race on one robot that is not randomized, all with these seeds.

    Each race has a process of its own: what one library leaves behind, such as JAX's threads, is none of the others'
    business. Peers whose packages are not here are left out, and it is said.

    Args:
        seed: The first seed.
        seeds: How many, counting up.
        conditions: Of all races.

    Returns:
        By the side's name, its races; physai comes first.
    """
    here = {name: peer for name, peer in PEERS.items() if find_spec(peer[0])}
    for name in PEERS.keys() - here.keys():
        print(f"{name}: {PEERS[name][0]} is not here; left out (pip install 'physai[bench]')", flush=True)
    threads = {name: apart(_fastest_threads, name) for name in here}
    races: dict[str, list[Race]] = {name: [] for name in (*OURS, *here)}
    for one in range(seed, seed + seeds):  # the sides take turns, so that a busy machine slows them alike
        for name in races:
            races[name].append(apart(_race, name, one, threads.get(name, 1), conditions))
    return races


def apart(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
        return executor.submit(function, *arguments).result()


def _settings(name: str) -> Settings:
    _, module, settings = PEERS[name]
    found: Settings = getattr(import_module(f"physai.bench.{module}"), settings)
    return found


def _fastest_threads(name: str) -> int:
    return fastest_threads(name, _settings(name))


def _race(name: str, seed: int, threads: int, conditions: Conditions) -> Race:
    config = reacher(seed, "randomization=none", *OURS.get(name, ()), *conditions.overrides)
    judged = reacher(seed, "randomization=none", *FAST_ENGINE, *conditions.overrides)
    evaluator = make_evaluation_env(judged, judged.randomization, conditions.goals, GOALS_SEED)
    race = Race(f"{name}, seed {seed}")
    try:
        if name in OURS:
            return race_physai(config, race, evaluator)
        settings = _settings(name)
        limits = {"max_seconds": conditions.peer_seconds, "max_frames": settings.horizon or math.inf}
        return race_peer(settings.learner(seed, threads), race, evaluator, **limits)
    finally:
        evaluator.close()


def race_physai(config: TrainConfig, race: Race, evaluator: TransformedRobotEnv) -> Race:
    """Let physai learn by a config until the evaluator's goals are reached, or until its ``total_frames``."""
    agent = Agent.build(config)
    batches = iter(agent.collector)

    def learn() -> int:
        batch = next(batches)
        agent.statistics.update(batch.get("observation"))
        agent.algorithm.update(batch)
        return batch.numel()

    def success_rate() -> float:
        evaluator.normalizer.load_state_dict(agent.statistics.normalizer.state_dict())
        with _workers_at_rest():
            return evaluate(agent.actor, evaluator, evaluator.batch_size[0], GOALS_SEED).success_rate

    try:
        return run_race(race, learn, success_rate, max_frames=config.total_frames)
    finally:
        agent.close()


@contextmanager
def _workers_at_rest() -> Iterator[None]:
    """Context in which collecting processes stand still: what they did meanwhile would not be on the clock."""
    workers = [process.pid for process in multiprocessing.active_children() if process.pid]
    for worker in workers:
        os.kill(worker, signal.SIGSTOP)
    try:
        yield
    finally:
        for worker in workers:
            os.kill(worker, signal.SIGCONT)


def race_peer(learner: Learner, race: Race, evaluator: TransformedRobotEnv, **limits: float) -> Race:
    """Let another library learn until the evaluator's goals are reached, or until a limit of ``run_race``."""
    policy = TensorDictModule(learner.act, in_keys=learner.in_keys, out_keys=["action"])

    def success_rate() -> float:
        return evaluate(policy, evaluator, evaluator.batch_size[0], GOALS_SEED).success_rate

    try:
        return run_race(race, learner.learn, success_rate, **limits)
    finally:
        learner.close()


def training_table(sides: dict[str, list[Race]]) -> Table:
    """Show each side's median and worst race (frames and speed are the median's), and what physai is ahead by."""
    title = f"Training until {TARGET:.0%} of {GOALS:,} unseen goals are reached, randomization=none"
    columns = (
        "seeds",
        "frames",
        "frames/s",
        "success",
        "median time",
        "physai ahead by",
        "worst time",
        "physai ahead by",
    )
    shown = table(title, "", *columns)
    physai = _median_and_worst(next(iter(sides.values())))
    for name, races in sides.items():
        median, worst = _median_and_worst(races)
        bound = "" if median.won else "> "
        success = f"{min(race.success_rate for race in races):.1%}"
        cells = [str(len(races)), f"{bound}{median.frames:,}", f"{median.frames_per_second:,.0f}", success]
        for ours, theirs in zip(physai, (median, worst), strict=True):
            cells += [f"{'' if theirs.won else '> '}{theirs.seconds:.1f} s", _ahead(ours, theirs)]
        shown.add_row(name, *cells)
    return shown


def _median_and_worst(races: list[Race]) -> tuple[Race, Race]:
    ranked = sorted(races, key=lambda race: (not race.won, race.seconds))
    return ranked[len(ranked) // 2], ranked[-1]


def _ahead(ours: Race, theirs: Race) -> str:
    if ours is theirs:
        return ""
    if not ours.won:
        return "unknown"
    return f"{'' if theirs.won else '> '}{theirs.seconds / ours.seconds:.1f}x"
