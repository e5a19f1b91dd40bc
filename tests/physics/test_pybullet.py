import subprocess
import sys

import numpy as np
import pybullet as bullet
import pytest

from physai.physics import RobotState, nominal_dynamics
from physai.physics.pybullet import PyBulletPhysics
from physai.robots import RobotSpec

DT = 0.02
WEAK = {"effort_limit": 0.2, "velocity_gain": 0.3}


@pytest.fixture(scope="module")
def spec(any_env):
    return RobotSpec.from_config(any_env.robot)


@pytest.fixture(scope="module")
def planar(reacher):
    return RobotSpec.from_config(reacher.robot)


@pytest.fixture
def make():
    """Make physics that is closed after the test."""
    made = []

    def make_physics(spec: RobotSpec, robots: int, **options: int) -> PyBulletPhysics:
        made.append(PyBulletPhysics(spec, robots, DT, **options))
        return made[-1]

    yield make_physics
    for physics in made:
        physics.close()


def dynamics(spec, rows, **changes):
    """Nominal dynamics of so many robots; ``changes`` are absolute: a number, or one value a robot."""
    values = {key: np.repeat(value, rows, axis=0) for key, value in nominal_dynamics(spec).items()}
    for key, value in changes.items():
        values[key] = np.broadcast_to(np.reshape(np.asarray(value, float), (-1, 1)), values[key].shape).copy()
    return values


def weak(spec, rows):
    values = dynamics(spec, rows, payload=1.0)
    return {**values, **{key: scale * values[key] for key, scale in WEAK.items()}}


def wild(spec, rows, random):
    """Dynamics that differ from robot to robot."""
    values = dynamics(spec, rows, payload=random.uniform(0, 1, rows))
    for key in ("link_mass", "effort_limit", "velocity_gain", "joint_damping", "joint_friction"):
        values[key] = values[key] * random.uniform(0.2, 1.0, values[key].shape)
    return values


def start(spec, rows, random):
    n = len(spec.joints)
    return spec.home + random.uniform(-1, 1, (rows, n)), random.uniform(-0.5, 0.5, (rows, n))


def commands(spec, steps, rows, random):
    """Velocity commands that hold for ten steps and then jump."""
    drawn = random.uniform(-2, 2, (-(-steps // 10), rows, len(spec.joints)))
    return np.repeat(drawn, 10, axis=0)[:steps]


def arrays(state):
    return np.array([state.joint_position, state.joint_velocity])


def run(physics, velocity_commands):
    return np.array([arrays(physics.step(command)) for command in velocity_commands])


def reset_all(physics, q, qd, parameters=None):
    physics.reset(np.arange(physics.num_robots), RobotState(q, qd), parameters)


def open_clients():
    return {client for client in range(1024) if bullet.getConnectionInfo(client)["isConnected"]}


@pytest.mark.parametrize("kind", [dynamics, weak, "wild"])
def test_a_robot_among_64_follows_what_it_follows_alone(spec, make, kind):
    random = np.random.default_rng(0)
    parameters = wild(spec, 64, random) if kind == "wild" else kind(spec, 64)
    q, qd = start(spec, 64, random)
    velocity_commands = commands(spec, 200, 64, random)
    crowd = make(spec, 64)
    reset_all(crowd, q, qd, parameters)
    together = run(crowd, velocity_commands)
    for row in (0, 15, 16, 31, 32, 63):
        alone = make(spec, 1)
        one = slice(row, row + 1)
        reset_all(alone, q[one], qd[one], {key: value[one] for key, value in parameters.items()})
        np.testing.assert_allclose(run(alone, velocity_commands[:, one]), together[:, :, one], rtol=0, atol=1e-6)
    assert np.ptp(together[-1, 0], axis=0).min() > 0.5  # robots did go different ways


def test_a_reset_robot_behaves_exactly_like_a_fresh_one_after_heavy_use(spec, make):
    random = np.random.default_rng(1)
    used, fresh = make(spec, 36), make(spec, 36)
    for _ in range(5):
        some = random.permutation(36)[:7]
        used.reset(some, RobotState(*start(spec, 7, random)), wild(spec, 7, random))
        run(used, commands(spec, 60, 36, random))
    rows = np.array([2, 15, 35])
    q, qd = start(spec, 3, random)
    for physics in (used, fresh):
        physics.reset(rows, RobotState(q, qd), weak(spec, 3))
    velocity_commands = commands(spec, 200, 36, random)
    np.testing.assert_array_equal(run(used, velocity_commands)[:, :, rows], run(fresh, velocity_commands)[:, :, rows])


def test_nominal_parameters_after_others_give_back_the_robot_as_made(spec, make):
    random = np.random.default_rng(2)
    used, fresh = make(spec, 3), make(spec, 3)
    reset_all(used, *start(spec, 3, random), wild(spec, 3, random))
    run(used, commands(spec, 50, 3, random))
    q, qd = start(spec, 3, random)
    reset_all(used, q, qd, dynamics(spec, 3))
    reset_all(fresh, q, qd)
    velocity_commands = commands(spec, 100, 3, random)
    np.testing.assert_array_equal(run(used, velocity_commands), run(fresh, velocity_commands))


def test_resetting_some_robots_leaves_the_others_bit_identical(spec, make):
    random = np.random.default_rng(3)
    q, qd = start(spec, 36, random)
    parameters = wild(spec, 36, random)
    disturbed, quiet = make(spec, 36), make(spec, 36)
    for physics in (disturbed, quiet):
        reset_all(physics, q, qd, parameters)
    kept = np.array([0, 3, 4, 16, 33])
    others = np.setdiff1d(np.arange(36), kept)
    for step, command in enumerate(commands(spec, 300, 36, random)):
        if step % 7 == 0:
            some = random.permutation(others)[:4]
            before = arrays(disturbed.robot_state())[:, kept]
            disturbed.reset(some, RobotState(*start(spec, 4, random)), wild(spec, 4, random))
            np.testing.assert_array_equal(arrays(disturbed.robot_state())[:, kept], before)
        a, b = arrays(disturbed.step(command)), arrays(quiet.step(command))
        np.testing.assert_array_equal(a[:, kept], b[:, kept])
    assert not np.array_equal(a[:, others], b[:, others])
    for key, value in disturbed.parameters().items():
        np.testing.assert_array_equal(value[kept], quiet.parameters()[key][kept])


@pytest.mark.parametrize("seed", range(3))
def test_a_restored_state_continues_bit_for_bit_in_a_fresh_instance(spec, make, seed):
    random = np.random.default_rng(seed)
    original = make(spec, 34)
    reset_all(original, *start(spec, 34, random), wild(spec, 34, random))
    run(original, commands(spec, 100, 34, random))
    original.reset(np.array([1, 33]), RobotState(*start(spec, 2, random)), weak(spec, 2))
    run(original, commands(spec, 33, 34, random))
    restored = make(spec, 34)
    run(restored, commands(spec, 5, 34, random))
    restored.set_state(original.state())
    np.testing.assert_array_equal(arrays(restored.robot_state()), arrays(original.robot_state()))
    velocity_commands = commands(spec, 300, 34, random)
    np.testing.assert_array_equal(run(restored, velocity_commands), run(original, velocity_commands))
    for key, value in restored.parameters().items():
        np.testing.assert_array_equal(value, original.parameters()[key])


def test_a_state_that_was_taken_does_not_change_with_what_happens_later(planar, make):
    random = np.random.default_rng(4)
    physics = make(planar, 4)
    reset_all(physics, *start(planar, 4, random), wild(planar, 4, random))
    taken = physics.state()
    copy = {key: value.copy() for key, value in taken.items()}
    run(physics, commands(planar, 20, 4, random))
    physics.reset(np.array([0, 2]), RobotState(*start(planar, 2, random)), wild(planar, 2, random))
    for key, value in copy.items():
        np.testing.assert_array_equal(taken[key], value, err_msg=key)


def test_returned_arrays_are_copies(planar, make):
    physics = make(planar, 2)
    q, qd = arrays(physics.step(np.ones((2, 2))))
    expected = q.copy()
    q += 1
    qd += 1
    physics.robot_state().joint_position[:] = 7
    physics.parameters()["effort_limit"][:] = 0
    np.testing.assert_array_equal(physics.robot_state().joint_position, expected)
    assert (physics.parameters()["effort_limit"] > 0).all()


def test_parameters_read_back_from_the_engine_are_those_that_were_set(spec, make):
    random = np.random.default_rng(5)
    physics = make(spec, 20)
    nominal = nominal_dynamics(spec)
    for key, value in physics.parameters().items():
        np.testing.assert_allclose(value, np.repeat(nominal[key], 20, axis=0), rtol=1e-9, atol=1e-12, err_msg=key)
    rows = np.array([0, 5, 19])
    q, qd = start(spec, 3, random)
    wanted = wild(spec, 3, random)
    wanted["joint_damping"] = random.uniform(0.1, 2.0, wanted["joint_damping"].shape)
    physics.reset(rows, RobotState(q, qd), wanted)
    run(physics, commands(spec, 5, 20, random))
    read = physics.parameters()
    for key, value in wanted.items():
        np.testing.assert_allclose(read[key][rows], value, rtol=1e-9, atol=1e-12, err_msg=key)
        others = np.delete(read[key], rows, axis=0)
        np.testing.assert_allclose(others, np.repeat(nominal[key], 17, axis=0), rtol=1e-9, atol=1e-12, err_msg=key)


def test_the_engine_itself_holds_the_masses_inertias_and_dampings(planar, make):
    # Looked up in PyBullet without the library's help.
    before = open_clients()
    physics = make(planar, 1)
    (client,) = open_clients() - before
    body = bullet.getBodyUniqueId(0, client)
    wanted = dynamics(planar, 1, payload=0.7)
    wanted["link_mass"] = np.array([[1.5, 0.9, 0.2]])
    wanted["joint_damping"] = np.array([[0.4, 0.6]])
    reset_all(physics, np.zeros((1, 2)), np.zeros((1, 2)), wanted)
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


def speeds(physics, parameters, steps, qd=0.0, command=1.0):
    """Joint velocities [steps, rows, n] of robots that hold one command from the same pose."""
    shape = (physics.num_robots, physics.robot_state().joint_position.shape[1])
    reset_all(physics, np.zeros(shape), np.full(shape, qd), parameters)
    return run(physics, np.full((steps, *shape), command))[:, 1]


def test_a_continuous_joint_turns_without_end(planar, make):
    physics = make(planar, 2)
    reset_all(physics, np.zeros((2, 2)), np.zeros((2, 2)))
    there_and_back = np.array([[2.0, 0.0], [-2.0, 0.0]])
    q, qd = run(physics, np.repeat(there_and_back[None], 1000, axis=0))[-1]
    np.testing.assert_allclose(q[:, 0], [40.0, -40.0], rtol=0.01)  # more than six turns
    np.testing.assert_allclose(qd, there_and_back, atol=0.02)


def test_less_effort_speeds_up_more_slowly(planar, make):
    physics = make(planar, 3)
    found = speeds(physics, dynamics(planar, 3, effort_limit=[0.5, 1.0, 5.0], joint_friction=0.0), 3)[0, :, 0]
    assert found[0] < 0.7 * found[1]
    assert found[1] < 0.9 * found[2]


def test_a_lower_velocity_gain_tracks_more_slowly(planar, make):
    physics = make(planar, 3)
    found = speeds(physics, dynamics(planar, 3, velocity_gain=[0.1, 0.3, 1.0], effort_limit=100.0), 1)[0, :, 0]
    assert found[0] < found[1] < found[2]
    assert found[2] == pytest.approx(1.0, abs=0.05)
    assert found[0] < 0.5


def test_friction_slows_speeding_up_and_holds_a_robot_that_is_too_weak_for_it(planar, make):
    physics = make(planar, 3)
    parameters = dynamics(planar, 3, effort_limit=1.0, joint_friction=[0.0, 0.5, 1.2])
    found = speeds(physics, parameters, 8)[-1, :, 0]
    assert found[0] > 1.5 * found[1] > 0.1
    assert found[2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("target", [0.5, 0.0, -0.5], ids=["slow down", "stop", "turn back"])
def test_friction_helps_to_brake(planar, make, target):
    physics = make(planar, 2)
    parameters = dynamics(planar, 2, joint_damping=0.0)
    parameters["effort_limit"] = np.array([[100.0, 0.3]] * 2)  # a strong first joint holds still
    parameters["joint_friction"] = np.array([[0.0, 0.0], [0.0, 0.2]])
    reset_all(physics, np.zeros((2, 2)), np.tile([0.0, 2.0], (2, 1)), parameters)
    frictionless, rubbing = physics.step(np.tile([0.0, target], (2, 1))).joint_velocity[:, 1]
    assert frictionless == pytest.approx(1.6, abs=0.1)
    assert rubbing == pytest.approx(2.0 - (2.0 - frictionless) * (0.3 + 0.2) / 0.3, abs=0.02)


@pytest.mark.parametrize("changes", [{"payload": [0.0, 1.0]}, {"link_mass": [0.5, 2.0]}], ids=["payload", "link_mass"])
def test_a_heavier_robot_speeds_up_more_slowly(planar, make, changes):
    physics = make(planar, 2)
    found = speeds(physics, dynamics(planar, 2, effort_limit=0.5, **changes), 4)[-1, :, 0]
    assert found[1] < 0.7 * found[0]


def test_damping_slows_an_arm_whose_motors_are_off(planar, make):
    physics = make(planar, 3)
    parameters = dynamics(planar, 3, effort_limit=0.0, joint_friction=0.0, joint_damping=[0.0, 0.2, 1.0])
    found = speeds(physics, parameters, 10, qd=1.0)[-1, :, 0]
    assert found[2] < 0.9 * found[1] < 0.9 * found[0]


def test_an_arm_without_motor_friction_and_damping_keeps_turning(planar, make):
    physics = make(planar, 1)
    parameters = dynamics(planar, 1, joint_friction=0.0, joint_damping=0.0)
    parameters["effort_limit"] = np.array([[0.0, 100.0]])  # the second joint is held
    reset_all(physics, np.zeros((1, 2)), np.array([[1.0, 0.0]]), parameters)
    assert run(physics, np.zeros((50, 1, 2)))[-1, 1, 0, 0] == pytest.approx(1.0, abs=1e-3)


def test_torque_over_inertia_is_the_acceleration(planar, make):
    physics = make(planar, 1)
    parameters = dynamics(planar, 1, joint_friction=0.0, joint_damping=0.0, payload=0.3)
    parameters["effort_limit"] = np.array([[0.8, 100.0]])
    reset_all(physics, np.zeros((1, 2)), np.zeros((1, 2)), parameters)
    speed = run(physics, np.tile([2.0, 0.0], (5, 1, 1)))[-1, 1, 0, 0]
    # about joint 1, with the arm stretched; the payload enlarges the tool, its own inertia too
    inertia = 0.00771 + 1.0 * 0.15**2 + 0.00319 + 0.6 * 0.425**2 + 1e-5 * 7 + 0.35 * 0.55**2
    assert speed == pytest.approx(5 * DT * 0.8 / inertia, rel=0.01)


def test_a_payload_pulls_a_weak_kuka_down(kuka_reacher, make):
    spec = RobotSpec.from_config(kuka_reacher.robot)
    physics = make(spec, 2)
    parameters = dynamics(spec, 2, effort_limit=60.0, payload=[0.0, 5.0])
    lying = np.tile([0.0, np.pi / 2], (2, 1))
    reset_all(physics, lying, np.zeros((2, 2)), parameters)
    drop = np.abs(run(physics, np.zeros((20, 2, 2)))[-1, 0, :, 1] - np.pi / 2)
    assert drop[1] > drop[0] + 0.01


def test_more_substeps_divide_the_control_period(planar, make):
    for substeps in (1, 4):
        physics = make(planar, 1, substeps=substeps)
        reset_all(physics, np.zeros((1, 2)), np.ones((1, 2)))
        assert run(physics, np.ones((50, 1, 2)))[-1, 0, 0, 0] == pytest.approx(50 * DT, rel=0.02)


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
from physai.config import compose, validate
from physai.envs.simulation import EnvConfig
from physai.physics import RobotState
from physai.physics.pybullet import PyBulletPhysics
from physai.robots import RobotSpec
spec = RobotSpec.from_config(validate(EnvConfig, compose("train", ["env=reacher"]).env).robot)
physics = PyBulletPhysics(spec, 20, 0.02)
for _ in range(10):
    physics.step(np.ones((20, 2)))
parameters = {k: v[:3] for k, v in physics.parameters().items()}
physics.reset(np.arange(3), RobotState(np.zeros((3, 2)), np.zeros((3, 2))), parameters)
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
        q, qd = start(planar, 1024, random)
        reset_all(physics, q, qd, weak(planar, 1024))
        velocity_commands = commands(planar, 20, 1024, random)
        found = run(physics, velocity_commands)
        assert np.isfinite(found).all()
        alone = PyBulletPhysics(planar, 1, DT)
        reset_all(alone, q[1000:1001], qd[1000:1001], weak(planar, 1))
        np.testing.assert_allclose(run(alone, velocity_commands[:, 1000:1001]), found[:, :, 1000:1001], atol=1e-6)
        alone.close()
    finally:
        physics.close()


@pytest.mark.parametrize("shape", [(3, 2), (4, 3), (8, 1), (2,)])
def test_commands_of_another_shape_are_refused(reacher, shape):
    physics = PyBulletPhysics(RobotSpec.from_config(reacher.robot), 4, 0.02)
    with pytest.raises(ValueError, match="shape"):
        physics.step(np.zeros(shape))
    physics.close()
