"""How fast the engines step robots, without policy or task."""

from argparse import Namespace
from functools import partial

import numpy as np
from rich.table import Table

from physai.bench.timing import median_speeds, reacher, table
from physai.physics import Physics
from physai.robots import RobotSpec
from physai.targets import make

ROBOTS = (1, 64, 512)
ARMS = {
    "planar arm": [],
    "KUKA, 2 joints": ["env=kuka_reacher"],
    "KUKA, 7 joints": [
        "env=kuka_reacher",
        f"env.robot.joints=[{','.join(f'lbr_iiwa_joint_{number}' for number in range(1, 8))}]",
        f"env.robot.home={[0.0] * 7}",
        f"env.robot.command_limit={[0.5] * 7}",
    ],
}
ENGINES = {
    "PyBullet": ["physics=pybullet"],
    "impulse": ["physics=mujoco", "physics.motor=impulse"],
    "impulse, 2 threads": ["physics=mujoco", "physics.motor=impulse", "physics.threads=2"],
    "servo": ["physics=mujoco", "physics.motor=servo"],
    "servo, 2 threads": ["physics=mujoco", "physics.motor=servo", "physics.threads=2"],
}
ROUNDS = 7
ROBOT_STEPS = 8192  # of each side in each round, at least a hundred steps
_HELD = 10  # steps that a command holds


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return engines_table(measure_engines(options.seed))


def measure_engines(seed: int) -> dict[tuple[str, int], list[float]]:
    """Return robot-steps/s of each engine, by arm and number of robots; the engines take turns."""
    speeds = {}
    for arm, overrides in ARMS.items():
        for robots in ROBOTS:
            made = [_physics(seed, robots, *overrides, *engine) for engine in ENGINES.values()]
            speeds[arm, robots] = median_speeds(*(partial(_step, *one) for one in made), rounds=ROUNDS)
            for physics, _ in made:
                physics.close()
            figures = ", ".join(
                f"{name} {speed:,.0f}/s" for name, speed in zip(ENGINES, speeds[arm, robots], strict=True)
            )
            print(f"{arm}, {robots:,} robots: {figures}", flush=True)
    return speeds


def _physics(seed: int, robots: int, *overrides: str) -> tuple[Physics, np.ndarray]:
    """An engine, and commands [T, N, n] for it, which jump every ten steps."""
    config = reacher(seed, *overrides).env
    spec = RobotSpec.from_config(config.robot)
    physics = make("env.physics", config.physics, spec, robots, config.control_dt, config.substeps)
    steps = max(100, ROBOT_STEPS // robots)
    drawn = np.random.default_rng(seed).uniform(-1.0, 1.0, (-(-steps // _HELD), robots, len(spec.joints)))
    return physics, np.repeat(drawn, _HELD, axis=0)[:steps] * spec.command_limit


def _step(physics: Physics, commands: np.ndarray) -> int:
    for command in commands:
        physics.step(command)
    return len(commands) * physics.num_robots


def engines_table(speeds: dict[tuple[str, int], list[float]]) -> Table:
    """A row for each arm and number of robots; after PyBullet's, speeds as multiples of it."""
    made = table("Robot-steps/s of the engines; those of MuJoCo as multiples of PyBullet's", "robots", *ENGINES)
    for (arm, robots), (pybullet, *others) in speeds.items():
        made.add_row(f"{arm}, {robots:,}", f"{pybullet:,.0f}", *(f"{speed / pybullet:.2f}" for speed in others))
    return made
