"""``python -m physai.bench``: speed against bare PyBullet and Stable-Baselines3 (see ``--help``)."""

import argparse
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pybullet as bullet
import torch
from rich.console import Console
from rich.table import Table
from tensordict.nn import TensorDictModule

from physai import cli
from physai.collectors import CollectorConfig, make_collector
from physai.config import compose, validate
from physai.envs.make import TransformedRobotEnv, make_env
from physai.errors import UserError
from physai.physics.pybullet import ROBOTS_PER_WORLD
from physai.robots import RobotSpec
from physai.seeding import derive
from physai.training.agent import Agent, make_actor, make_evaluation_env
from physai.training.config import TrainConfig
from physai.training.evaluation import evaluate

ROBOTS = (1, 16, 64, 128, 256, 512, 1024)
ROUNDS = 7
BATCHES_PER_ROUND = 7  # longer than an episode, so that every round pays for its resets

TARGET = 0.99
GOALS = 1000
GOALS_SEED = derive(0, "benchmark goals")  # the same for both sides, unseen in training
JUDGE_EVERY = 8192  # frames; one batch of Stable-Baselines3, two of physai

SB3_ENVS = 4
SB3_THREADS = (1, 2)
# The numbers that users know; all but ent_coef are also its defaults.
SB3_PPO: dict[str, Any] = {
    "learning_rate": 3e-4,
    "n_steps": 2048,
    "batch_size": 64,
    "n_epochs": 10,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.005,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
}


def main() -> None:
    """Measure, then show the figures as tables."""
    options = _options()
    with cli.guard():
        if not options.collect and find_spec("stable_baselines3") is None:
            raise UserError("no stable_baselines3 here: pip install 'physai[bench]', or use --collect")
        print(machine(), flush=True)
        tables = []
        if not options.train:
            tables.append(collection_table(*measure_collection(options.seed)))
        if not options.collect:
            tables.append(training_table(*measure_training(options.seed, options.seeds, options.sb3_frames)))
        Console().print(*tables)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m physai.bench",
        description="Measure physai on the two-link arm: how fast it collects, against a bare PyBullet loop, "
        "and how soon its policy reaches 99 % of 1,000 unseen goals, against Stable-Baselines3 PPO.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--collect", action="store_true", help="measure collection only")
    part.add_argument("--train", action="store_true", help="measure training only")
    parser.add_argument("--seed", type=int, default=0, help="seed of both sides")
    parser.add_argument("--seeds", type=int, default=1, help="train physai so often, with seeds counting up")
    sb3_frames = "where Stable-Baselines3 gives up; what physai is ahead by is then a lower bound"
    parser.add_argument("--sb3-frames", type=int, default=2_000_000, help=sb3_frames)
    options = parser.parse_args()
    if options.seed < 0 or options.seeds < 1 or options.sb3_frames < 1:
        parser.error("--seed must not be negative, --seeds and --sb3-frames must be positive")
    return options


def machine() -> str:
    """Describe what the figures are measured on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model = models[0] if models else platform.processor() or platform.machine()
    packages = [name for name in ("torch", "torchrl", "pybullet", "stable_baselines3") if find_spec(name)]
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return (
        f"{model}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n"
        f"Python {platform.python_version()}, {versions}"
    )


def timed(work: Callable[[], int]) -> tuple[int, float]:
    """Return what ``work`` says it did, and the seconds that it took."""
    started = time.perf_counter()
    done = work()
    return done, time.perf_counter() - started


def median_speeds(*sides: Callable[[], int], rounds: int) -> list[float]:
    """Return each side's median work per second; they take turns, so that a busy machine slows them alike."""
    for side in sides:
        side()
    results = [[timed(side) for side in sides] for _ in range(rounds)]
    return [statistics.median(done / seconds for done, seconds in side) for side in zip(*results, strict=True)]


@contextmanager
def bare_loop(spec: RobotSpec, control_dt: float, commands: np.ndarray) -> Iterator[Callable[[], int]]:
    """Make the least that one can do with PyBullet: command, step, read; in worlds as small as physai's.

    Args:
        spec: The robot.
        control_dt: Control period, s; one physics step.
        commands: Joint velocities to play, rad/s, [T, N, n].

    Yields:
        A function that plays all commands and returns the number of robot-steps.
    """
    steps, robots, _ = commands.shape
    sizes = [min(ROBOTS_PER_WORLD, robots - first) for first in range(0, robots, ROBOTS_PER_WORLD)]
    worlds = [_bare_world(spec, size, control_dt) for size in sizes]
    client, (body, *_) = worlds[0]
    infos = [bullet.getJointInfo(body, joint, client) for joint in range(bullet.getNumJoints(body, client))]
    indices = {info[1].decode(): info[0] for info in infos}
    joints, efforts = [indices[name] for name in spec.joints], spec.effort_limit.tolist()
    plan = commands.tolist()

    def play() -> int:
        command, step, read = bullet.setJointMotorControl2, bullet.stepSimulation, bullet.getJointStates
        mode = bullet.VELOCITY_CONTROL
        for targets in plan:
            rows = iter(targets)
            for client, bodies in worlds:
                for body in bodies:
                    for joint, target, effort in zip(joints, next(rows), efforts):  # noqa: B905
                        command(body, joint, mode, 0.0, target, effort, 0.1, 1.0, 0.0, client)
                step(client)
                for body in bodies:
                    read(body, joints, client)
        return steps * robots

    try:
        yield play
    finally:
        for client, _ in worlds:
            bullet.disconnect(client)


def _bare_world(spec: RobotSpec, robots: int, time_step: float) -> tuple[int, list[int]]:
    client = bullet.connect(bullet.DIRECT)
    bullet.setTimeStep(time_step, client)
    bullet.setGravity(0, 0, -9.81, client)
    options = {"useFixedBase": True, "flags": bullet.URDF_USE_INERTIA_FROM_FILE, "physicsClientId": client}
    bodies = [bullet.loadURDF(str(spec.urdf), **options) for _ in range(robots)]
    for body in bodies:
        for link in range(-1, bullet.getNumJoints(body, client)):
            bullet.setCollisionFilterGroupMask(body, link, 0, 0, client)
    return client, bodies


def measure_collection(seed: int) -> tuple[int, dict[int, list[float]]]:
    """Return the default number of robots; and by their number, robot-steps/s bare and of the collector."""
    config = _config(seed)
    torch.set_num_threads(config.threads)
    speeds = {}
    for robots in sorted({*ROBOTS, config.collector.num_envs}):
        bare, collector = speeds[robots] = _collection_speeds(config, robots)
        print(f"{robots:>5,} robots: collector {collector:>8,.0f}/s, bare {bare:>8,.0f}/s", flush=True)
    return config.collector.num_envs, speeds


def _collection_speeds(config: TrainConfig, robots: int) -> list[float]:
    steps = config.collector.frames_per_batch // config.collector.num_envs
    size = CollectorConfig(num_envs=robots, frames_per_batch=steps * robots)
    total_frames = (1 + ROUNDS) * BATCHES_PER_ROUND * size.frames_per_batch
    env = make_env(config.env, config.randomization, config.normalization, robots, config.seed)
    collector = make_collector(size, env, make_actor(config, env), total_frames)
    batches = iter(collector)

    def collect() -> int:
        frames = 0
        for _ in range(BATCHES_PER_ROUND):
            batch = next(batches)
            env.normalization.update(batch.get("observation"))
            frames += batch.numel()
        return frames

    # Like an untrained policy's, the commands change all the time: a settled motor is cheaper to solve.
    shape = (BATCHES_PER_ROUND * steps, robots, len(env.simulation.spec.joints))
    commands = config.env.max_velocity * np.random.default_rng(config.seed).uniform(-1, 1, shape)
    with bare_loop(env.simulation.spec, config.env.control_dt, commands) as bare:
        try:
            return median_speeds(bare, collect, rounds=ROUNDS)
        finally:
            collector.shutdown()


@dataclass
class Race:
    """How a learner fared; its clock counts learning alone, not building and not judging."""

    name: str
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
        return self.success_rate >= TARGET


def run_race(name: str, learn: Callable[[], int], judge: Callable[[], float], max_frames: int) -> Race:
    """Learn until a judgement finds the target reached, or until ``max_frames``.

    Args:
        name: The learner's.
        learn: One iteration of collecting and learning; returns its frames.
        judge: Returns the success rate of the policy as it is.
        max_frames: Where to give up.
    """
    race = Race(name)
    while not race.won and race.frames < max_frames:
        due = min(race.frames + JUDGE_EVERY, max_frames)
        while race.frames < due:
            frames, seconds = timed(learn)
            race.frames += frames
            race.seconds += seconds
        race.success_rate = judge()
        print(
            f"{name}: {race.frames:>9,} frames  {race.seconds:6.1f} s  {race.frames_per_second:>6,.0f}/s  "
            f"success {race.success_rate:6.1%}",
            flush=True,
        )
    return race


def measure_training(seed: int, seeds: int, sb3_frames: int) -> tuple[list[Race], Race]:
    """Race on one robot that is not randomized: physai with so many seeds, then Stable-Baselines3."""
    configs = [_config(one, "randomization=none") for one in range(seed, seed + seeds)]
    judge = make_evaluation_env(configs[0], configs[0].randomization, GOALS, GOALS_SEED)
    try:
        return [_race_physai(config, judge) for config in configs], _race_sb3(seed, judge, sb3_frames)
    finally:
        judge.close()


def _race_physai(config: TrainConfig, judge: TransformedRobotEnv) -> Race:
    agent = Agent.build(config)
    batches = iter(agent.collector)

    def learn() -> int:
        batch = next(batches)
        agent.env.normalization.update(batch.get("observation"))
        agent.algorithm.update(batch)
        return batch.numel()

    def success_rate() -> float:
        judge.normalization.load_state_dict(agent.env.normalization.state_dict())
        return evaluate(agent.actor, judge, GOALS, GOALS_SEED).success_rate

    try:
        return run_race(f"physai, seed {config.seed}", learn, success_rate, config.total_frames)
    finally:
        agent.close()


def _race_sb3(seed: int, judge: TransformedRobotEnv, max_frames: int) -> Race:
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    envs = make_vec_env("physai/Reacher-v0", SB3_ENVS)  # a DummyVecEnv; PPO seeds it

    def make_model(**changed: int) -> PPO:
        return PPO("MlpPolicy", envs, seed=seed, device="cpu", **SB3_PPO | changed)

    def learn(model: PPO, threads: int) -> int:
        torch.set_num_threads(threads)
        before = model.num_timesteps
        model.learn(1, reset_num_timesteps=False)  # rounds up to one batch
        return model.num_timesteps - before

    def act(observation: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(model.predict(observation.numpy(), deterministic=True)[0])

    trial = make_model(n_steps=256)
    speeds = median_speeds(*(partial(learn, trial, threads) for threads in SB3_THREADS), rounds=1)
    threads = SB3_THREADS[speeds.index(max(speeds))]
    measured = ", ".join(f"{speed:,.0f}/s with {n}" for n, speed in zip(SB3_THREADS, speeds, strict=True))
    print(f"Stable-Baselines3 by torch threads: {measured}; it gets {threads}", flush=True)

    model = make_model()
    policy = TensorDictModule(act, in_keys=["observation"], out_keys=["action"])

    def success_rate() -> float:
        return evaluate(policy, judge, GOALS, GOALS_SEED).success_rate

    try:
        return run_race("Stable-Baselines3", partial(learn, model, threads), success_rate, max_frames)
    finally:
        envs.close()


def _config(seed: int, *overrides: str) -> TrainConfig:
    return validate(TrainConfig, compose("train", ["env=reacher", f"seed={seed}", *overrides]))


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", min_width=len(title))
    for column in columns:
        table.add_column(column, justify="right")
    return table


def collection_table(default: int, speeds: dict[int, list[float]]) -> Table:
    """Show robot-steps per second; the default number of robots stands out."""
    title = "Collection, robot-steps/s: one process, one thread, randomization=default"
    table = _table(title, "robots", "bare PyBullet", "TorchRL collector", "ratio")
    for robots, (bare, collector) in speeds.items():
        style, mark = ("bold", " (default)") if robots == default else (None, "")
        figures = f"{bare:,.0f}", f"{collector:,.0f}", f"{collector / bare:.2f}"
        table.add_row(f"{robots:,}{mark}", *figures, style=style)
    return table


def training_table(races: list[Race], sb3: Race) -> Table:
    """Show both sides, and what physai's median is ahead by."""
    title = f"Training until {TARGET:.0%} of {GOALS:,} unseen goals are reached, randomization=none"
    table = _table(title, "", "frames", "frames/s", "time", "success")
    for race in (*races, sb3):
        bound, speed = "" if race.won else "> ", f"{race.frames_per_second:,.0f}"
        time_taken, success = f"{bound}{race.seconds:.1f} s", f"{race.success_rate:.1%}"
        table.add_row(race.name, f"{bound}{race.frames:,}", speed, time_taken, success)
    faster = statistics.median(race.frames_per_second for race in races) / sb3.frames_per_second
    seconds = statistics.median(race.seconds if race.won else math.inf for race in races)
    sooner = f"{'' if sb3.won else '> '}{sb3.seconds / seconds:.1f}x" if math.isfinite(seconds) else "unknown"
    table.add_section()
    table.add_row("physai is ahead by", "", f"{faster:.1f}x", sooner, "", style="bold")
    return table


if __name__ == "__main__":
    main()
