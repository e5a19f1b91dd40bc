"""Many robots in PyBullet's worlds, which nobody else's worlds are touched by."""

import subprocess
import sys

import numpy as np
import pybullet as bullet
import pytest

from physai.physics.pybullet import PyBulletPhysics
from tests.physics.moving import (
    DT,
    commands,
    dynamics,
    one_of,
    reset_all,
    resting,
    run,
    start,
    weak,
)


def open_clients():
    return {client for client in range(1024) if bullet.getConnectionInfo(client)["isConnected"]}


@pytest.mark.parametrize("engine", ["pybullet"], indirect=True)
def test_the_engine_itself_holds_the_masses_inertias_and_dampings(planar, make):
    # Looked up in PyBullet without the library's help.
    before = open_clients()
    physics = make(planar, 1)
    (client,) = open_clients() - before
    body = bullet.getBodyUniqueId(0, client)
    wanted = dynamics(planar, 1, payload=0.7)
    wanted["link_mass"] = np.array([[1.5, 0.9, 0.2]])
    wanted["joint_damping"] = np.array([[0.4, 0.6]])
    reset_all(physics, resting(1), wanted)
    masses = dict(zip(planar.moving_links, [1.5, 0.9, 0.9], strict=True))
    dampings = {"joint1": 0.4, "joint2": 0.6}
    nominal = {"link1": 1.0, "link2": 0.6, "tool": 0.05}
    inertia = {"link1": [0.00033, 0.00763, 0.00771], "link2": [0.00011, 0.00316, 0.00319], "tool": [2e-5, 2e-5, 1e-5]}
    inertia = {link: np.array(moments) for link, moments in inertia.items()}
    bullet.syncBodyInfo(client)  # getJointInfo answers from a cache that changeDynamics does not reach
    for index in range(bullet.getNumJoints(body, client)):
        info = bullet.getJointInfo(body, index, client)
        joint, link = info[1].decode(), info[12].decode()
        found = bullet.getDynamicsInfo(body, index, client)
        assert found[0] == pytest.approx(masses[link])
        np.testing.assert_allclose(found[2], inertia[link] * masses[link] / nominal[link], rtol=1e-6)
        if joint in dampings:
            assert info[6] == pytest.approx(dampings[joint])


def test_closing_frees_all_worlds_and_may_happen_twice(planar):
    before = open_clients()
    physics = PyBulletPhysics(planar, 70, DT)
    other = PyBulletPhysics(planar, 1, DT)
    assert len(open_clients() - before) == 3 + 1
    physics.close()
    assert len(open_clients() - before) == 1
    other.step(np.ones((1, 2)))
    physics.close()
    other.close()
    assert open_clients() == before


@pytest.mark.slow
def test_a_client_that_someone_else_opened_is_not_touched():
    script = """
import numpy as np, pybullet as bullet
client = bullet.connect(bullet.DIRECT)
assert client == 0
shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=0.1)
ball = bullet.createMultiBody(1.0, shape, basePosition=(0, 0, 5))
bullet.setTimeStep(0.123)
def seen():
    return (bullet.getNumBodies(0), bullet.getPhysicsEngineParameters(0), bullet.getBasePositionAndOrientation(ball),
            bullet.getBaseVelocity(ball), bullet.getDynamicsInfo(ball, -1))
before = seen()
from physai.compose import compose
from physai.config import validate
from physai.envs.simulation import EnvConfig
from physai.physics import RobotState
from physai.physics.pybullet import PyBulletPhysics
from physai.robots import RobotSpec
spec = RobotSpec.from_config(validate(EnvConfig, compose("train", ["env=reacher"]).env).robot)
physics = PyBulletPhysics(spec, 20, 0.02)
for _ in range(10):
    physics.step(np.ones((20, 2)))
state = RobotState(np.zeros((3, 2)), np.zeros((3, 2)))
physics.reset(np.arange(3), state, {k: v[:3] for k, v in physics.parameters().items()})
physics.set_state(physics.state())
assert seen() == before
physics.close()
assert seen() == before and bullet.isConnected(0)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_thousand_robots_work_in_one_process(planar):
    random = np.random.default_rng(6)
    physics = PyBulletPhysics(planar, 1024, DT)
    try:
        begin = start(planar, 1024, random)
        reset_all(physics, begin, weak(planar, 1024))
        velocity_commands = commands(planar, 20, 1024, random)
        found = run(physics, velocity_commands)
        assert np.isfinite(found).all()
        alone = PyBulletPhysics(planar, 1, DT)
        reset_all(alone, one_of(begin, slice(1000, 1001)), weak(planar, 1))
        np.testing.assert_allclose(run(alone, velocity_commands[:, 1000:1001]), found[:, :, 1000:1001], atol=1e-6)
        alone.close()
    finally:
        physics.close()
