"""Where episodes begin: around home, or where the last one ended."""

import numpy as np
import pytest
import torch
from scipy import stats
from tensordict.nn import TensorDictModule

import physai
from physai.envs.gym_env import RobotVectorEnv
from physai.envs.simulation import Simulation
from physai.training.evaluation import evaluate

CARRIED = "env.start.carried_over=1.0"
SHORT = ("env.task.max_steps=10", "env.task.tolerance=1e-6")


@pytest.fixture
def simulate(env_config):
    """Make a simulation that is closed after the test."""
    made = []

    def make(*overrides, name="reacher", robots=64):
        made.append(Simulation(env_config(name, *overrides), robots, seed=0))
        return made[-1]

    yield make
    for simulation in made:
        simulation.close()


def move(simulation, steps=10, seed=0):
    action = np.random.default_rng(seed).uniform(-1, 1, (simulation.num_envs, 2))
    for _ in range(steps):
        simulation.step(action)


@pytest.mark.slow
def test_starts_are_uniform_around_home_and_at_rest(simulate, two_joint_env):
    simulation = simulate(name=two_joint_env.name, robots=500)
    starts = []
    for _ in range(6):
        move(simulation, 1)
        simulation.reset()
        starts.append(simulation.state.joint_position)
        assert not simulation.state.joint_velocity.any()
    spread, home = two_joint_env.start.spread, simulation.spec.home
    for joint, width in enumerate(spread):
        column = np.concatenate(starts)[:, joint]
        assert stats.kstest(column, stats.uniform(home[joint] - width, 2 * width).cdf).pvalue > 1e-3


def test_starts_stay_within_the_limits_of_each_joint(simulate):
    simulation = simulate("env.start.spread=[100.0,100.0]")
    simulation.reset()
    assert np.abs(simulation.state.joint_position[:, 0]).max() > 50  # it turns without end
    assert np.abs(simulation.state.joint_position[:, 1]).max() == 2.6


def test_starts_and_goals_follow_the_seed(simulate):
    simulation, drawn = simulate(), []
    for seed in (1, 1, 2):
        simulation.seed(seed)
        simulation.reset()
        drawn.append(np.hstack([simulation.state.joint_position, simulation.goal]))
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.isclose(drawn[0], drawn[2]).any()


def test_a_carried_over_episode_begins_where_the_last_one_ended_and_as_fast(simulate):
    simulation = simulate(CARRIED)
    simulation.reset()
    move(simulation)
    ended, goal = simulation.state, simulation.goal
    simulation.reset()
    np.testing.assert_array_equal(simulation.state.joint_position, ended.joint_position)
    np.testing.assert_array_equal(simulation.state.joint_velocity, ended.joint_velocity)
    assert not np.isclose(simulation.goal, goal).all(axis=1).any()
    assert not simulation.episode_length.any()
    move(simulation, 1, seed=1)  # and the robots go on from there
    apart = np.abs(simulation.state.joint_position - ended.joint_position)
    assert 0 < apart.max() < 0.06


def test_each_row_carries_its_own_end_over_at_its_own_reset(simulate):
    simulation = simulate(CARRIED)
    simulation.reset()
    move(simulation)
    ended = simulation.state.joint_position
    rows = np.arange(64) % 3 == 0
    simulation.reset(rows)
    np.testing.assert_array_equal(simulation.state.joint_position, ended)
    assert (simulation.episode_length[:, 0] == np.where(rows, 0, 10)).all()


def test_a_share_of_a_half_carries_about_half_of_the_episodes_over(simulate):
    simulation = simulate("env.start.carried_over=0.5", robots=400)
    simulation.reset()
    shares = []
    for seed in range(3):
        move(simulation, seed=seed)
        ended = simulation.state
        simulation.reset()
        carried = (simulation.state.joint_position == ended.joint_position).all(axis=1)
        fresh = ~carried
        assert not simulation.state.joint_velocity[fresh].any()
        np.testing.assert_array_equal(simulation.state.joint_velocity[carried], ended.joint_velocity[carried])
        shares.append(carried.mean())
    assert np.mean(shares) == pytest.approx(0.5, abs=0.05)
    assert len(set(shares)) > 1


def test_a_training_env_carries_over_what_its_episodes_end_with():
    env = physai.make_env("reacher", 8, 0, [CARRIED, *SHORT, "randomization=strong"])
    td = env.reset()
    generator = torch.Generator().manual_seed(0)
    begun = 0
    for _ in range(35):
        ended = env.simulation.state
        stepped, td = env.step_and_maybe_reset(td.set("action", 2 * torch.rand(8, 2, generator=generator) - 1))
        done = stepped["next", "done"][:, 0].numpy()
        begun += done.sum()
        moved = np.abs(env.simulation.state.joint_position - ended.joint_position)
        assert moved.max() < 0.1  # nobody is ever put elsewhere
    assert begun == 3 * 8
    env.close()


def test_in_a_vector_env_no_step_lies_between_the_end_of_an_episode_and_the_start_of_the_next():
    env = RobotVectorEnv("reacher", 4, overrides=[CARRIED, *SHORT])
    env.reset(seed=0)
    for _ in range(10):
        _, _, _, truncated, _ = env.step(np.ones((4, 2), np.float32))
    assert truncated.all()
    ended = env.simulation.state
    env.step(np.ones((4, 2), np.float32))
    np.testing.assert_array_equal(env.simulation.state.joint_position, ended.joint_position)
    np.testing.assert_array_equal(env.simulation.state.joint_velocity, ended.joint_velocity)
    env.close()


def test_what_a_seed_starts_does_not_depend_on_where_robots_were_before(simulate):
    simulation = simulate(CARRIED)
    starts = []
    for _ in range(2):
        simulation.seed(3)
        for _ in range(2):
            simulation.reset()
            starts.append(np.hstack([simulation.state.joint_position, simulation.state.joint_velocity]))
            move(simulation)
    np.testing.assert_array_equal(starts[:2], starts[2:])
    assert starts[0].std(axis=0)[:2].min() > 1.0  # the first ones are spread, for nothing could be carried over


def test_an_evaluation_follows_from_its_seed_alone_with_episodes_that_are_carried_over():
    env = physai.make_env("reacher", 8, 0, [CARRIED, "env.task.max_steps=30"])
    spin = TensorDictModule(lambda seen: torch.ones(len(seen), 2), in_keys=["observation"], out_keys=["action"])
    first = evaluate(spin, env, 16, seed=5)
    evaluate(spin, env, 8, seed=6)
    again = evaluate(spin, env, 16, seed=5)
    for name in ("success", "length", "error", "episode_return"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    env.close()


def test_a_gymnasium_env_repeats_a_seeded_episode_with_starts_that_are_carried_over():
    env = RobotVectorEnv("reacher", 4, overrides=[CARRIED, *SHORT])
    seen = []
    for _ in range(2):
        steps = [env.reset(seed=3)[0]]
        steps += [env.step(np.full((4, 2), 0.7, np.float32))[0] for _ in range(25)]
        seen.append(np.array(steps))
    np.testing.assert_array_equal(seen[0], seen[1])
    env.close()
