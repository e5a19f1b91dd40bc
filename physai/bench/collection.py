"""How fast robots are collected from, against a bare PyBullet loop."""

from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import pybullet as bullet
import torch
from rich.console import Group
from rich.table import Table

from physai.bench.timing import median_speeds, reacher, table
from physai.collectors import make_collector
from physai.envs.make import make_env
from physai.physics.pybullet import APART, robots_per_world
from physai.robots import RobotSpec
from physai.training.agent import make_actor
from physai.training.config import TrainConfig
from physai.transforms import RunningStatistics

ROBOTS = (1, 16, 64, 128, 256, 512, 1024)
COLLECTORS = ("single", "async", "multi_sync", "multi_async", "ray")
ROUNDS = 7
STEPS_PER_ROUND = 112  # longer than most episodes, so that every round pays for its resets
SMALL = 32  # fewer robots hand over one batch a round: nobody would collect batches of a few frames


def run(options: Namespace) -> Group:
    """Measure, and show it."""
    return Group(
        collection_table(*measure_collection(options.seed)), collectors_table(measure_collectors(options.seed))
    )


def measure_collection(seed: int) -> tuple[int, dict[int, list[float]]]:
    """Return the default number of robots; and by their number, robot-steps/s bare, of one process and of two."""
    config = reacher(seed, "collector=single")  # two processes of which are multi_sync
    torch.set_num_threads(config.threads)
    speeds = {}
    for robots in sorted({*ROBOTS, config.collector.num_envs}):
        speeds[robots] = _collection_speeds(config, robots)
        figures = zip(("bare", "one process", "two"), speeds[robots], strict=True)
        print(f"{robots:>5,} robots: {', '.join(f'{name} {speed:,.0f}/s' for name, speed in figures)}", flush=True)
    return config.collector.num_envs, speeds


def measure_collectors(seed: int) -> dict[str, float]:
    """Return robot-steps/s by collector, each with the default number of robots in each of its processes.

    They are measured one after the other: one that does not wait for the learner would be at work in others' turns.
    """
    speeds = {}
    for name in COLLECTORS:
        config = reacher(seed, f"collector={name}")
        torch.set_num_threads(config.threads)
        size = config.collector
        with collecting(config, size.num_envs, size.processes) as side:
            (speeds[name],) = median_speeds(side, rounds=ROUNDS)
        print(f"collector={name}: {speeds[name]:,.0f}/s", flush=True)
    return speeds


def _collection_speeds(config: TrainConfig, robots: int) -> list[float]:
    spec = RobotSpec.from_config(config.env.robot)
    # Like an untrained policy's, the commands change all the time: a settled motor is cheaper to solve.
    shape = (STEPS_PER_ROUND, robots, len(spec.joints))
    commands = spec.command_limit * np.random.default_rng(config.seed).uniform(-1, 1, shape)
    with (
        bare_loop(spec, config.env.control_dt, commands) as bare,
        collecting(config, robots, processes=1) as one,
        collecting(config, robots, processes=2) as two,
    ):
        return median_speeds(bare, one, two, rounds=ROUNDS)


@contextmanager
def collecting(config: TrainConfig, robots: int, processes: int) -> Iterator[Callable[[], int]]:
    """Make what a learner waits for: batches from so many robots in each process."""
    batches = 1 if robots < SMALL else STEPS_PER_ROUND * config.collector.num_envs // config.collector.frames_per_batch
    frames = STEPS_PER_ROUND // batches * robots * processes
    sizes = {"num_envs": robots * processes, "frames_per_batch": frames, "processes": processes}
    size = config.collector.model_copy(update=sizes)
    make_robots = partial(make_env, config.env, config.randomization, config.normalization)
    env = make_robots(size.envs_of_learner, config.seed)
    statistics = RunningStatistics(env.normalizer, config.normalization.eps)
    total_frames = (1 + ROUNDS) * batches * frames
    actor, cpu = make_actor(config, env), torch.device("cpu")
    collector = make_collector(size, env, make_robots, actor, total_frames, config.seed, 0, cpu)
    source = iter(collector)

    def collect() -> int:
        for _ in range(batches):
            statistics.update(next(source).get("observation"))
        return batches * frames

    try:
        yield collect
    finally:
        collector.shutdown()


def collection_table(default: int, speeds: dict[int, list[float]]) -> Table:
    """Show robot-steps per second; the default number of robots stands out."""
    title = "Collection, robot-steps/s: one thread a process, randomization=default"
    columns = "robots a process", "bare PyBullet", "one process", "of bare", "two processes", "of one"
    shown = table(title, *columns)
    for robots, (bare, one, two) in speeds.items():
        style, mark = ("bold", " (default)") if robots == default else (None, "")
        figures = f"{bare:,.0f}", f"{one:,.0f}", f"{one / bare:.2f}", f"{two:,.0f}", f"{two / one:.2f}"
        shown.add_row(f"{robots:,}{mark}", *figures, style=style)
    return shown


def collectors_table(speeds: dict[str, float]) -> Table:
    """Show robot-steps per second of each collector."""
    shown = table(
        "Collectors, robot-steps/s: default robots a process, nothing learned", "collector", "speed", "of single"
    )
    for name, speed in speeds.items():
        shown.add_row(name, f"{speed:,.0f}", f"{speed / speeds['single']:.2f}")
    return shown


@contextmanager
def bare_loop(spec: RobotSpec, control_dt: float, commands: np.ndarray) -> Iterator[Callable[[], int]]:
    """Make the least that one can do with PyBullet: command, step, read; in worlds like physai's.

    Args:
        spec: The robot.
        control_dt: Control period, s; one physics step.
        commands: Joint velocities to play, rad/s, [T, N, n].

    Yields:
        A function that plays all commands and returns the number of robot-steps.
    """
    steps, robots, _ = commands.shape
    most = robots_per_world(spec)
    sizes = [min(most, robots - first) for first in range(0, robots, most)]
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
    bodies = [bullet.loadURDF(str(spec.urdf), (APART * robot, 0, 0), **options) for robot in range(robots)]
    for body in bodies:
        for link in range(-1, bullet.getNumJoints(body, client)):
            bullet.setCollisionFilterGroupMask(body, link, 0, 0, client)
    return client, bodies
