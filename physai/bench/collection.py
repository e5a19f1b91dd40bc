"""How fast robots are collected from, against a bare PyBullet loop."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pybullet as bullet
import torch
from rich.table import Table

from physai.bench.timing import median_speeds, reacher, table
from physai.collectors import CollectorConfig, make_collector
from physai.envs.make import make_env
from physai.physics.pybullet import ROBOTS_PER_WORLD
from physai.robots import RobotSpec
from physai.training.agent import make_actor
from physai.training.config import TrainConfig

ROBOTS = (1, 16, 64, 128, 256, 512, 1024)
ROUNDS = 7
BATCHES_PER_ROUND = 7  # longer than an episode, so that every round pays for its resets


def measure_collection(seed: int) -> tuple[int, dict[int, list[float]]]:
    """Return the default number of robots; and by their number, robot-steps/s bare and of the collector."""
    config = reacher(seed)
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


def collection_table(default: int, speeds: dict[int, list[float]]) -> Table:
    """Show robot-steps per second; the default number of robots stands out."""
    title = "Collection, robot-steps/s: one process, one thread, randomization=default"
    shown = table(title, "robots", "bare PyBullet", "TorchRL collector", "ratio")
    for robots, (bare, collector) in speeds.items():
        style, mark = ("bold", " (default)") if robots == default else (None, "")
        figures = f"{bare:,.0f}", f"{collector:,.0f}", f"{collector / bare:.2f}"
        shown.add_row(f"{robots:,}{mark}", *figures, style=style)
    return shown


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
