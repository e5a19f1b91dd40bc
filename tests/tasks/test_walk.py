"""Walking: what is commanded, what a fall is, what is paid, and that it is the same robot in each engine."""

import dataclasses

import numpy as np
import pytest
import torch

import physai
from physai.envs.simulation import Simulation
from physai.errors import UserError

QUICK = ("physics=mujoco", "env.task.max_steps=60", "env.task.goal_steps=20")


@pytest.fixture
def simulate(env_config):
    made = []

    def make(*overrides, robots=4):
        made.append(Simulation(env_config("a1_walk", *QUICK, *overrides), robots, seed=0))
        made[-1].reset()
        return made[-1]

    yield make
    for simulation in made:
        simulation.close()


def still(simulation, steps):
    for _ in range(steps):
        ended = simulation.step(np.zeros((simulation.num_envs, len(simulation.spec.joints)), np.float32))
    return ended


def term(simulation, name):
    return simulation.episode_rewards[:, simulation.reward_terms.index(name)]


def test_commands_lie_within_their_bounds_and_some_ask_to_stand(simulate):
    task = simulate("env.task.stand=0.3").task
    goals = task.sample_goal(1000, torch.Generator().manual_seed(0))
    stands = (goals == 0).all(axis=1)
    assert 0.25 < stands.mean() < 0.35
    assert goals[~stands][:, 0].min() >= 0.3
    assert goals[:, 0].max() <= 0.8
    assert all(map(task.region.contains, goals))


def test_another_command_comes_in_the_midst_of_an_episode_and_the_mean_error_is_over_all_of_it(simulate):
    simulation = simulate()
    goals, errors = [], []
    for _ in range(60):
        goals.append(simulation.goal.copy())
        _, terminated, truncated = still(simulation, 1)
        errors.append(simulation.error)
    changed = [step for step in range(1, 60) if not np.array_equal(goals[step], goals[step - 1])]
    assert changed == [20, 40]
    assert truncated.all()
    assert not terminated.any()
    np.testing.assert_allclose(simulation.error_sum / 60, np.mean(errors, axis=0))


def test_to_stand_where_that_is_asked_is_a_success_and_pays_nearly_all_that_there_is(simulate):
    simulation = simulate("env.task.stand=1.0", "env.start.spread=[0,0,0,0,0,0,0,0,0,0,0,0]")
    still(simulation, 60)
    assert simulation.success.all()
    weights = simulation.config.task["reward"]
    assert (term(simulation, "velocity") > 0.8 * 60 * 0.02 * weights["velocity"]).all()
    assert (term(simulation, "fall") == 0).all()


def test_a_robot_that_stands_still_where_it_shall_walk_has_no_success(simulate):
    simulation = simulate("env.task.stand=0.0")
    still(simulation, 60)
    assert not simulation.success.any()


def test_a_fall_ends_an_episode(simulate):
    simulation = simulate()
    state = simulation.state
    turned = state.base_pose.copy()
    turned[0, 3:] = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    simulation.physics.reset(np.arange(4), dataclasses.replace(state, base_pose=turned))
    _, terminated, truncated = still(simulation, 1)
    assert terminated[:, 0].tolist() == [True, False, False, False]
    assert not truncated.any()
    assert term(simulation, "fall")[0] < 0


def suggested(simulation):
    """Let robots do what the gait suggests; return their mean errors after the first second, [2]."""
    module, errors = simulation.task.module, []
    for _ in range(149):
        sensed = simulation.sense()
        arrays = [torch.from_numpy(np.asarray(sensed[name], np.float32)) for name in (*module.senses, "goal")]
        _, features = module(*arrays)
        _, terminated, _ = simulation.step(torch.tanh(features[:, -12:]).numpy())
        assert not terminated.any()
        errors.append(simulation.error.mean(axis=0))
    return np.mean(errors[50:], axis=0)


WHOLE = ("env.task.max_steps=150", "env.task.goal_steps=150")


@pytest.mark.slow
def test_the_suggested_gait_alone_walks_about_as_it_is_told(simulate):
    assert (suggested(simulate(*WHOLE, robots=64)) < 1.5 * simulate().tolerance).all()


@pytest.mark.slow
def test_a_gait_that_feels_how_it_turns_follows_the_yaw_rate_better(simulate):
    blind = suggested(simulate(*WHOLE, "env.task.gait.yaw_correction=0.0", robots=64))
    assert suggested(simulate(*WHOLE, robots=64))[1] < 0.92 * blind[1]


def test_pushes_move_the_base_and_a_robot_that_gets_none_goes_on_as_before(simulate):
    pushed, calm = simulate(robots=64), simulate(robots=64)
    parameters = calm.physics_parameters.copy()
    parameters[:32, calm.layout.columns["push"]] = 1.0
    pushed.reset(parameters=parameters)
    calm.reset()
    still(pushed, 15)
    still(calm, 15)
    apart = np.abs(pushed.state.base_twist[:, :2] - calm.state.base_twist[:, :2]).max(axis=1)
    assert (apart[:32] > 0.1).any()


def test_the_module_says_what_the_policy_sees_in_both_engines_and_scripts(simulate):
    module = torch.jit.script(simulate().task.module)
    for engine in ("mujoco", "pybullet"):
        env = physai.make_env("a1_walk", 2, 0, [f"physics={engine}", "randomization=default"])
        rollout = env.rollout(3)
        seen = [rollout[name].reshape(6, -1) for name in (*env.simulation.task.module.senses, "goal")]
        observation, features = module(*seen)
        torch.testing.assert_close(observation, rollout["observation"].reshape(6, -1))
        torch.testing.assert_close(features, rollout["features"].reshape(6, -1))
        assert rollout["gravity"].norm(dim=-1) == pytest.approx(1.0, abs=1e-5)
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (("env.task.low=[1,0,0]",), r"env.task.low: .* must not be above env.task.high"),
        (("env.task.gait.lift=-0.1",), r"^env.task.gait.lift: input should be greater than or equal to 0, got -0.1"),
        (("env.task.reward.fall=-1.0",), r"^env.task.reward.fall: input should be greater than or equal to 0, got -1"),
        (("+env.task.gait.phases=1",), r"^unknown key 'env.task.gait.phases'"),
        (("env.task.gait=3",), r"^env.task.gait: keys and values are needed, got 3"),
        (("env.start.carried_over=0.5",), "env.start.carried_over: a robot whose base floats may have fallen"),
        (("robot@env.robot=planar_arm", "env.start.spread=[0,0]"), "'planar_arm' does not walk: its base is fixed"),
    ],
)
def test_what_cannot_be_walked_is_refused_in_one_line(simulate, overrides, line):
    with pytest.raises(UserError, match=line):
        simulate(*overrides)


def test_an_arm_s_task_is_refused_for_a_robot_without_an_end_effector(env_config):
    config = env_config("reacher", "robot@env.robot=a1", f"env.start.spread={[0] * 12}")
    with pytest.raises(UserError, match="robot 'a1' has no end effector"):
        Simulation(config, 1, seed=0)
