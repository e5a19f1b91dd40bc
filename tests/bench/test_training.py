"""Other libraries are told of our robots what they expect, and all learners race, are timed and shown."""

import multiprocessing
import os
import sys
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from rich.console import Console
from stable_baselines3.common.vec_env import VecCheckNan
from torch.distributions import Distribution

from physai.bench import rsl_rl, sb3, training
from physai.bench.learner import THREADS, fastest_threads
from physai.bench.sb3 import Learner, RobotVecEnv
from physai.bench.training import Race, training_table
from physai.envs.gym_env import RobotVectorEnv

ROBOTS = 16
SHORT = "env.task.max_steps=20"


@pytest.fixture(autouse=True)
def _torch_stays_as_it_is(monkeypatch):
    monkeypatch.setattr(Distribution, "_validate_args", Distribution._validate_args)
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def make():
    made = []

    def make_envs(*overrides, features=False):
        made.append(RobotVecEnv(RobotVectorEnv("reacher", ROBOTS, overrides=overrides), features))
        return made[-1]

    yield make_envs
    for envs in made:
        envs.close()


def actions(steps):
    return np.random.default_rng(0).uniform(-1, 1, (steps, ROBOTS, 2)).astype(np.float32)


def test_an_episode_is_the_one_of_the_gymnasium_vector_env(make):
    near = "env.task.tolerance=0.3"  # so that some reach their goal
    envs, twin = make(SHORT, near), RobotVectorEnv("reacher", ROBOTS, overrides=[SHORT, near])
    envs.seed(0)
    envs.reset()
    twin.reset()
    twin.simulation.restore(envs.simulation.snapshot())
    going, ends = np.ones(ROBOTS, bool), []
    for action in actions(20):
        observation, reward, done, infos = envs.step(action)
        expected, expected_reward, terminated, truncated, _ = twin.step(action)
        assert observation.dtype == reward.dtype == np.float32
        assert [bool(info) for info in infos] == done.tolist()
        for row in going.nonzero()[0]:
            last = infos[row].get("terminal_observation", observation[row])
            np.testing.assert_allclose(last, expected[row], atol=1e-6)
            assert (reward[row], done[row]) == (expected_reward[row], terminated[row] or truncated[row])
            if done[row]:
                assert infos[row]["TimeLimit.truncated"] == truncated[row]
                ends.append(bool(truncated[row]))
        going &= ~done
    twin.close()
    assert not going.any()
    assert {True, False} == set(ends)


def test_a_row_that_is_done_starts_anew_in_the_same_step(make):
    envs = make(SHORT)
    envs.reset()
    goals = envs.simulation.goal
    for action in actions(20):
        observation, _, done, infos = envs.step(action)
    assert done.any()
    assert (envs.simulation.episode_length[done] == 0).all()
    for row in done.nonzero()[0]:
        assert (observation[row, 2:4] == 0).all()  # at rest
        np.testing.assert_array_equal(observation[row, 6:], envs.simulation.goal[row].astype(np.float32))
        assert not np.allclose(infos[row]["terminal_observation"][6:], observation[row, 6:])
    assert not np.array_equal(goals, envs.simulation.goal)


@pytest.mark.parametrize("features", [False, True])
def test_observations_are_those_of_the_task_where_a_joint_turns_around(make, features):
    envs = make("env.task.tolerance=1e-6", features=features)
    envs.reset()
    for _ in range(190):
        observation = envs.step(np.ones((ROBOTS, 2), np.float32))[0]
    now = envs.simulation
    assert now.state.joint_position[:, 0].max() > 4  # more than half a turn
    sensed = (torch.from_numpy(v).float() for v in (now.state.joint_position, now.state.joint_velocity, now.goal))
    expected = torch.cat(now.task.module(*sensed)[: 1 + features], dim=1).numpy()
    np.testing.assert_allclose(observation, expected, atol=2e-6)
    assert all(envs.observation_space.contains(row) for row in observation)


def test_equal_seeds_give_equal_goals_and_no_seed_goes_on(make):
    envs, seen = make(), []
    for seed in (3, 3, 4, None):
        if seed is not None:
            envs.seed(seed)
        seen.append(envs.reset())
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not any(np.allclose(seen[1], other) for other in seen[2:])


def test_what_is_asked_of_single_rows(make):
    envs = make()
    assert envs.get_attr("render_mode", indices=[0, 3]) == [None, None]
    assert envs.env_is_wrapped(RobotVectorEnv) == [False] * ROBOTS
    for refused in (partial(envs.set_attr, "num_envs", 2), partial(envs.env_method, "render")):
        with pytest.raises(NotImplementedError):
            refused()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DEFAULTS", "TUNED", "TUNED_WITH_FEATURES"])
def test_stable_baselines3_learns_batch_by_batch(name):
    settings = getattr(sb3, name)
    learner = Learner(settings, seed=0, n_steps=16)
    model = learner.model
    model.env = VecCheckNan(model.env, raise_exception=True)
    assert_learns(learner, frames := 16 * model.n_envs)
    left = 1 - frames / settings.horizon if settings.horizon else 1.0  # the second batch's
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(settings.arguments["learning_rate"] * left)
    learner.close()


@pytest.mark.parametrize("settings", [rsl_rl.ISAAC_LAB, rsl_rl.TUNED, rsl_rl.TUNED_WITH_FEATURES])
def test_rsl_rl_learns_batch_by_batch(settings):
    learner = replace(settings, robots=ROBOTS).learner(seed=0)
    assert_learns(learner, ROBOTS * settings.steps)
    learner.close()


@pytest.mark.slow
def test_the_threads_that_learn_fastest_are_chosen(capsys, monkeypatch):
    def speeds(*trials, rounds):
        return [trial() * float(number) for number, trial in enumerate(trials, 1)]  # each learns a batch of one size

    monkeypatch.setattr("physai.bench.learner.median_speeds", speeds)
    assert fastest_threads("rsl_rl", replace(rsl_rl.TUNED, robots=4)) == THREADS[-1]
    assert f"it gets {THREADS[-1]}" in capsys.readouterr().out


def assert_learns(learner, frames):
    seen = [torch.zeros(3, size) for size in (8, 12)[: len(learner.in_keys)]]
    before = learner.act(*seen)
    assert [learner.learn(), learner.learn()] == [frames, frames]
    after = learner.act(*seen)
    assert after.shape == (3, 2)
    assert after.abs().max() <= 1
    assert not torch.equal(before, after)


def test_rsl_rl_sees_an_episode_of_the_gymnasium_vector_env():
    """It restarts rows in the step that ends them, says which of them ran out of time, and clips what it is told."""
    envs = rsl_rl.RobotVecEnv(RobotVectorEnv("reacher", ROBOTS, overrides=[SHORT, "env.task.tolerance=0.3"]))
    twin = RobotVectorEnv("reacher", ROBOTS, overrides=[SHORT, "env.task.tolerance=0.3"])
    envs.seed(0)
    twin.simulation.seed(0)
    twin.simulation.reset()
    going, ends = np.ones(ROBOTS, bool), set()
    for action in actions(20):
        told = torch.from_numpy(3 * action)
        observation, reward, done, extras = envs.step(told)
        expected, expected_reward, terminated, truncated, _ = twin.step(np.clip(3 * action, -1, 1))
        rows = going & ~done.numpy()
        np.testing.assert_array_equal(observation["policy"].numpy()[rows], expected[rows])
        np.testing.assert_array_equal(reward.numpy()[going], expected_reward[going])
        assert (done.numpy() == (terminated | truncated))[going].all()
        assert (extras["time_outs"].numpy() == (truncated & ~terminated))[going].all()
        ends |= set(truncated[going & done.numpy()].tolist())
        assert (envs.episode_length_buf[done] == 0).all()
        going &= ~done.numpy()
    envs.close()
    twin.close()
    assert not going.any()
    assert ends == {True, False}


def _count(counter):
    while True:
        counter.value += 1
        time.sleep(0.001)


def test_workers_stand_still_while_a_policy_is_judged():
    context = multiprocessing.get_context("fork")
    counter = context.Value("q", 0, lock=False)
    worker = context.Process(target=_count, args=[counter], daemon=True)
    worker.start()
    try:
        assert _moves(counter)
        with training._workers_at_rest():
            time.sleep(0.05)  # a signal takes its time
            assert not _moves(counter)
        assert _moves(counter)
    finally:
        worker.kill()
        worker.join()


def _moves(counter):
    before = counter.value
    time.sleep(0.2)
    return counter.value > before


def race(seconds, success_rate=1.0):
    return Race("a", frames=1000, seconds=seconds, success_rate=success_rate)


def shown(sides):
    console = Console(width=200, record=True)
    console.print(training_table(sides))
    return console.export_text()


def test_the_table_shows_median_worst_and_what_physai_is_ahead_by():
    text = shown({"physai": [race(2.0), race(4.0), race(1.0)], "b": [race(20.0)], "c": [race(30.0, 0.5)]})
    rows = {
        line.split("│")[1].strip(): [cell.strip() for cell in line.split("│")[2:-1]]
        for line in text.splitlines()[3:]
        if "│" in line
    }
    assert rows["physai"] == ["3", "1,000", "500", "100.0%", "2.0 s", "", "4.0 s", ""]
    assert rows["b"] == ["1", "1,000", "50", "100.0%", "20.0 s", "10.0x", "20.0 s", "5.0x"]
    assert rows["c"] == ["1", "> 1,000", "33", "50.0%", "> 30.0 s", "> 15.0x", "> 30.0 s", "> 7.5x"]


def test_who_does_not_arrive_is_ahead_of_nobody():
    assert "unknown" in shown({"physai": [race(1.0, 0.5)], "b": [race(20.0)]})


@pytest.mark.slow
def test_learners_race_in_processes_of_their_own(monkeypatch, capfd):
    """JAX, whose threads no fork survives, is in none but its own; and who is not here is left out by name."""
    apart, chosen = training.apart, training._fastest_threads  # which learns, and JAX compiles for seconds
    monkeypatch.setattr(training, "apart", lambda what, *given: 1 if what is chosen else apart(what, *given))
    imported = set(sys.modules)
    peers = {name: training.PEERS[name] for name in ("SBX, tuned, physai's features",)}
    monkeypatch.setattr(training, "PEERS", peers | {"Nobody": ("no_such_package", "nobody", "NOTHING")})
    monkeypatch.setattr(training, "OURS", {"physai": ()})
    short = training.Conditions(peer_seconds=0.1, goals=20, overrides=(SHORT, "total_frames=2048"))
    sides = training.measure_training(seed=0, seeds=1, conditions=short)
    assert list(sides) == ["physai", *peers]
    for name, (one,) in sides.items():
        assert one.frames >= 2048
        assert one.seconds > 0
        assert name in shown(sides)
    assert "Nobody: no_such_package is not here; left out" in capfd.readouterr().out
    assert "jax" not in sys.modules.keys() - imported
    assert apart(os.getpid) != os.getpid()


@pytest.mark.parametrize("name", [name for name, peer in training.PEERS.items() if peer[0] != "sbx"])
def test_each_peer_has_settings(name):
    """SBX learns in a process of its own, above: where JAX is, no other test could fork."""
    assert training._settings(name).learner
