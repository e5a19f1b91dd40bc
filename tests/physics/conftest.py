"""Robots that engines are tried with."""

from collections.abc import Callable, Iterator
from functools import partial

import pytest

from physai.envs.simulation import EnvConfig
from physai.physics import Physics
from physai.physics.mujoco import MuJoCoPhysics
from physai.physics.pybullet import PyBulletPhysics
from physai.robots import RobotSpec
from tests.physics.moving import DT


@pytest.fixture(scope="module")
def spec(any_arm: EnvConfig) -> RobotSpec:
    """Each robot whose base is fixed, in turn."""
    return RobotSpec.from_config(any_arm.robot)


@pytest.fixture(scope="module")
def planar(reacher: EnvConfig) -> RobotSpec:
    return RobotSpec.from_config(reacher.robot)


MOTOR = {"motor_time_constant": 0.015, "threads": 1}
ENGINES = {
    "pybullet": PyBulletPhysics,
    "impulse": partial(MuJoCoPhysics, motor="impulse", **MOTOR),
    "servo": partial(MuJoCoPhysics, motor="servo", **MOTOR),
}


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> Callable[..., Physics]:
    """Each engine in turn, and with each of its motors."""
    return ENGINES[request.param]


@pytest.fixture
def make(engine: Callable[..., Physics]) -> Iterator[Callable[..., Physics]]:
    """Make physics that is closed after the test."""
    made = []

    def make_physics(spec: RobotSpec, robots: int, **options: int) -> Physics:
        made.append(engine(spec, robots, DT, **options))
        return made[-1]

    yield make_physics
    for physics in made:
        physics.close()
