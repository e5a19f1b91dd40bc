"""How fast robots on legs are collected from, against bare MuJoCo; and what training them costs."""

from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from rich.console import Group
from rich.table import Table

from physai.bench.collection import STEPS_PER_ROUND, collecting
from physai.bench.growth import Run, train_apart
from physai.bench.timing import config_of, median_speeds, table
from physai.envs.make import make_env
from physai.physics.interface import at_home
from physai.physics.mujoco import MuJoCoPhysics
from physai.robots import RobotSpec
from physai.targets import make
from physai.training.agent import make_actor
from physai.training.config import TrainConfig

ENV, ENGINE = "a1_walk", "physics=mujoco"
ROBOTS = (512, 1024)
FRAMES = 245_760
ROUNDS = 5


def run(options: Namespace) -> Group:
    """Measure, and show it."""
    return Group(
        walk_table(measure_walk(options.seed)),
        training_table([train_apart(ENV, FRAMES, robots, options.seed, ENGINE) for robots in ROBOTS]),
    )


def measure_walk(seed: int) -> dict[int, list[float]]:
    """Return robot-steps/s by the number of robots: bare, and collected by one process and by two."""
    config = config_of(ENV, seed, ENGINE, "collector=single")
    torch.set_num_threads(config.threads)
    speeds = {}
    for robots in ROBOTS:
        with (
            bare_batch(config, robots) as bare,
            collecting(config, robots, processes=1) as one,
            collecting(config, robots, processes=2) as two,
        ):
            speeds[robots] = median_speeds(bare, one, two, rounds=ROUNDS)
        figures = zip(("bare", "one process", "two"), speeds[robots], strict=True)
        print(f"{robots:>5,} robots: {', '.join(f'{name} {speed:,.0f}/s' for name, speed in figures)}", flush=True)
    return speeds


@contextmanager
def bare_batch(config: TrainConfig, robots: int) -> Iterator[Callable[[], int]]:
    """Make the least that one can do with MuJoCo's batch: command and step the same model, on one thread.

    Yields:
        A function that lets robots walk from home on, as an untrained policy told them, and returns the number of
        robot-steps.
    """
    env, spec = config.env, RobotSpec.from_config(config.env.robot)
    physics: MuJoCoPhysics = make("env.physics", env.physics, spec, robots, env.control_dt, env.substeps)
    batch, commands = physics._batch, _walked(config, robots)

    def play() -> int:
        physics.reset(np.arange(robots), at_home(spec, robots))
        for command in commands:
            batch.ctrl = command
            batch.step(nstep=env.substeps)
        return STEPS_PER_ROUND * robots

    try:
        yield play
    finally:
        physics.close()


@torch.no_grad()
def _walked(config: TrainConfig, robots: int) -> list[np.ndarray]:
    """What robots are told in a round, rad, [N, n] each."""
    env = make_env(config.env, config.randomization, config.normalization, robots, config.seed)
    actor, commands = make_actor(config, env), []
    tensordict = env.reset()
    for _ in range(STEPS_PER_ROUND):
        tensordict = env.step(actor(tensordict)).get("next")
        commands.append(env.simulation.last_command)
    env.close()
    return commands


def walk_table(speeds: dict[int, list[float]]) -> Table:
    """Show robot-steps per second."""
    title = "A1, robot-steps/s: one thread a process, randomization=default"
    shown = table(title, "robots", "bare MuJoCo", "one process", "of bare", "two processes", "of one")
    for robots, (bare, one, two) in speeds.items():
        shown.add_row(
            f"{robots:,}", f"{bare:,.0f}", f"{one:,.0f}", f"{one / bare:.2f}", f"{two:,.0f}", f"{two / one:.2f}"
        )
    return shown


def training_table(runs: list[Run]) -> Table:
    """Show what training costs; while it learns from one batch, the next one is collected."""
    columns = "robots", "frames", "frames/s", "peak memory", "waited for batches", "learned"
    shown = table("Training of the A1", *columns)
    for each in runs:
        shown.add_row(
            f"{each.robots:,}",
            f"{each.frames:,}",
            f"{each.frames / each.seconds:,.0f}",
            f"{each.megabytes:,.0f} MB",
            f"{each.waited:.1f} s",
            f"{each.learned:.1f} s",
        )
    return shown
