import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from physai.errors import UserError
from physai.physics import nominal_dynamics
from physai.physics.parallel import ParallelPhysics
from physai.physics.pybullet import PyBulletPhysics
from physai.robots import RobotSpec

DT = 0.02
ROBOTS = 7


@pytest.fixture(scope="module")
def spec(any_env):
    return RobotSpec.from_config(any_env.robot)


@pytest.fixture
def make():
    """Make physics, in one process if no other number is given, that is closed after the test."""
    made = []

    def make_physics(spec, processes=None, robots=ROBOTS):
        share = () if processes is None else (PyBulletPhysics, processes)
        made.append((ParallelPhysics if share else PyBulletPhysics)(spec, robots, DT, 1, *share))
        return made[-1]

    yield make_physics
    for physics in made:
        physics.close()


def dynamics(spec, rows, random):
    """Dynamics that differ from robot to robot."""
    values = {key: np.repeat(value, rows, axis=0) for key, value in nominal_dynamics(spec).items()}
    return {key: value * random.uniform(0.5, 1.0, value.shape) for key, value in values.items()}


def assert_equal(found, wanted):
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


def use(all_physics, spec, steps=40, seed=0):
    """Step and reset all alike, with new dynamics now and then, and see that they stay alike."""
    random = np.random.default_rng(seed)
    for step in range(steps):
        command = random.uniform(-2, 2, (ROBOTS, len(spec.joints)))
        states = [physics.step(command) for physics in all_physics]
        for state in states[1:]:
            assert_equal(state, states[0])
        if step % 7 == 3:
            rows = np.sort(random.choice(ROBOTS, random.integers(1, ROBOTS + 1), replace=False))
            start = random.uniform(-0.5, 0.5, (len(rows), len(spec.joints)))
            new = dynamics(spec, len(rows), random) if step % 2 else None
            for physics in all_physics:
                physics.reset(rows, start, np.zeros_like(start), new)
                assert_equal(physics.joint_state(), all_physics[0].joint_state())


@pytest.fixture
def children():
    """The processes that have been started since, and still run."""
    before = set(multiprocessing.active_children())
    return lambda: set(multiprocessing.active_children()) - before


def workers_of(physics):
    return [worker._process for worker in physics._workers]


def test_robots_move_bit_for_bit_as_in_one_process(spec, make):
    shares = [make(spec), make(spec, 1), make(spec, 2), make(spec, 3)]
    use(shares, spec)
    alone, *others = (physics.parameters() for physics in shares)
    for parameters in others:
        assert parameters.keys() == alone.keys()
        assert_equal(parameters.values(), alone.values())


def test_a_state_goes_on_bit_for_bit_in_any_number_of_processes(spec, make):
    before = make(spec, 2)
    use([before], spec)
    after = [make(spec), make(spec, 3)]
    for physics in after:
        physics.set_state(before.state())
        assert_equal(physics.joint_state(), before.joint_state())
    use([before, *after], spec, seed=1)


def test_returned_arrays_are_the_callers(spec, make):
    physics, other = make(spec, 2), make(spec)
    command = np.ones((ROBOTS, len(spec.joints)))
    for array in (*physics.step(command), *physics.joint_state()):
        array[:] = 9.0
    other.step(command)
    assert_equal(physics.step(command), other.step(command))


@pytest.mark.parametrize("processes", [0, ROBOTS + 1])
def test_as_many_processes_as_robots_are_the_most(spec, processes):
    with pytest.raises(UserError, match="processes"):
        ParallelPhysics(spec, ROBOTS, DT, 1, PyBulletPhysics, processes)


def test_commands_of_another_shape_are_refused_and_nothing_moves(spec, make):
    physics = make(spec, 2)
    before = physics.joint_state()
    with pytest.raises(ValueError, match="shape"):
        physics.step(np.zeros((ROBOTS, 1 + len(spec.joints))))
    assert_equal(physics.joint_state(), before)


def test_a_share_that_cannot_be_made_is_told_and_neither_process_nor_world_is_left(spec, children):
    made = []

    def refuse(spec, robots, control_dt, substeps):
        if robots < ROBOTS - ROBOTS // 2:  # the worker's share
            raise UserError("no room")
        made.append(PyBulletPhysics(spec, robots, control_dt, substeps))
        return made[-1]

    with pytest.raises(UserError, match="no room"):
        ParallelPhysics(spec, ROBOTS, DT, 1, refuse, 2)
    assert not children()
    (own,) = made
    assert not own._worlds


def test_a_mistake_in_a_share_reaches_the_caller_and_ends_the_processes(spec, make, children):
    physics = make(spec, 2)
    last, start = np.array([ROBOTS - 1]), np.zeros((1, len(spec.joints)))
    physics.reset(last, start, start, {"no such key": np.zeros((1, 1))})
    with pytest.raises(KeyError):
        physics.step(np.zeros((ROBOTS, len(spec.joints))))
    assert not children()
    with pytest.raises(UserError, match="closed"):
        physics.step(np.zeros((ROBOTS, len(spec.joints))))


def test_a_process_that_is_killed_is_named_in_one_line_and_the_others_end(spec, make, children):
    physics = make(spec, 3)
    assert len(children()) == 2
    worker = workers_of(physics)[0]
    worker.kill()
    worker.join()
    with pytest.raises(UserError, match=r"process that computes physics has ended \(exit code -9\)"):
        physics.step(np.zeros((ROBOTS, len(spec.joints))))
    assert not children()


def test_closing_ends_the_processes_and_may_happen_twice(spec, make, children):
    physics = make(spec, 3)
    physics.close()
    physics.close()
    assert not children()


def test_physics_that_nobody_closes_takes_its_processes_along(spec, children):
    physics = ParallelPhysics(spec, ROBOTS, DT, 1, PyBulletPhysics, 3)
    assert len(children()) == 2
    del physics
    gc.collect()
    assert not children()


def test_a_copy_in_a_fork_leaves_the_processes_alone(spec):
    physics = ParallelPhysics(spec, ROBOTS, DT, 1, PyBulletPhysics, 2)
    child = os.fork()
    if child == 0:
        del physics
        gc.collect()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    physics.step(np.zeros((ROBOTS, len(spec.joints))))
    physics.close()


def test_a_process_that_nobody_can_ask_any_more_ends_by_itself(spec, make):
    physics = make(spec, 2)
    (worker,) = physics._workers
    worker._connection.close()
    worker._process.join(timeout=10)
    assert worker._process.exitcode == 0


@pytest.mark.parametrize("end", ["", "os.kill(os.getpid(), signal.SIGKILL)"], ids=["ends", "is killed"])
def test_no_process_is_left_of_an_env_that_nobody_closed(end):
    script = f"""
import os, signal
import gymnasium, physai
envs = gymnasium.make_vec("physai/Reacher-v0", 4, vectorization_mode="vector_entry_point", processes=3)
envs.reset(seed=0)
print(*(worker._process.pid for worker in envs.unwrapped.simulation.physics._workers), flush=True)
{end}
"""
    started = time.monotonic()
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == (-signal.SIGKILL if end else 0), done.stderr
    pids = done.stdout.splitlines()[-1].split()
    assert len(pids) == 2
    while any(os.path.exists(f"/proc/{pid}") for pid in pids):
        assert time.monotonic() < started + 60
        time.sleep(0.05)
