"""Robots that engines are tried with."""

from collections.abc import Callable, Iterator

import pytest

from physai.envs.simulation import EnvConfig
from physai.physics.pybullet import PyBulletPhysics
from physai.robots import RobotSpec
from tests.physics.moving import DT


@pytest.fixture(scope="module")
def spec(any_env: EnvConfig) -> RobotSpec:
    """The robot of each environment in turn."""
    return RobotSpec.from_config(any_env.robot)


@pytest.fixture(scope="module")
def planar(reacher: EnvConfig) -> RobotSpec:
    return RobotSpec.from_config(reacher.robot)


@pytest.fixture
def make() -> Iterator[Callable[..., PyBulletPhysics]]:
    """Make physics that is closed after the test."""
    made = []

    def make_physics(spec: RobotSpec, robots: int, **options: int) -> PyBulletPhysics:
        made.append(PyBulletPhysics(spec, robots, DT, **options))
        return made[-1]

    yield make_physics
    for physics in made:
        physics.close()
