"""What any task may rely on: errors of its module, time at the goal, rewards by name, success that ends nothing."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import check_env_specs

import physai
from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.physics import RobotState
from physai.training.evaluation import evaluate

TASK = ("~env.task", "+env.task={_target_: tests.tasks.hold.Hold, hold: 0.1, max_steps: 80}")
EXACT = "env.physics={_target_: tests.physics.dummy.DummyPhysics}"
STILL = "env.start.spread=[0,0]"
LEAVES_AT = 50


@pytest.fixture
def simulation(env_config):
    """Four robots that follow at once, from home, with goals at home."""
    made = Simulation(env_config("reacher", *TASK, EXACT, STILL), 4, seed=0)
    made.reset()
    made.goal = np.zeros((4, 2))
    yield made
    made.close()


@pytest.fixture
def make():
    made = []

    def make_env(robots, *overrides):
        made.append(physai.make_env("reacher", robots, 0, [*TASK, "randomization=none", *overrides]))
        return made[-1]

    yield make_env
    for env in made:
        env.close()


def move(simulation, speed):
    """One step of all robots, first joints at so many rad/s each."""
    action = np.zeros((4, 2))
    action[:, 0] = np.asarray(speed) / simulation.spec.command_limit[0]
    return simulation.step(action)


def test_errors_and_observations_are_those_of_the_module_where_a_task_does_not_write_them_again(simulation):
    random = np.random.default_rng(0)
    q, qd, goal = random.uniform(-2, 2, (3, 4, 2))
    task, state = simulation.task, RobotState(q, qd)
    np.testing.assert_allclose(task.error(state, goal), np.abs(goal - q), rtol=0, atol=1e-6)
    observation = task.observe({"joint_position": q, "joint_velocity": qd, "goal": goal})
    assert observation.dtype == np.float32
    np.testing.assert_allclose(observation, np.hstack([q, qd, goal]), rtol=0, atol=1e-6)


def test_a_goal_counts_as_held_while_every_error_is_within_its_tolerance(simulation):
    held = []
    simulation.goal = np.array([[0.0, 0.0], [0.0, 0.06], [0.06, 0.0], [0.049, -0.049]])
    for _ in range(5):
        move(simulation, 0.0)
        held.append(simulation.within.tolist())
    assert held == [[step, 0, 0, step] for step in (1, 2, 3, 4, 5)]


def test_a_moment_beyond_the_tolerance_starts_the_time_anew(simulation):
    for _ in range(8):
        move(simulation, 0.0)
    assert simulation.success[:, 0].all()
    away, back = [0.0, 2.0, 0.0, 0.0], [0.0, -2.0, 0.0, 0.0]
    for _ in range(2):  # 0.04 rad a step
        move(simulation, away)
    assert simulation.within.tolist() == [10, 0, 10, 10]
    assert simulation.success[:, 0].tolist() == [True, False, True, True]
    for _ in range(2):
        move(simulation, back)
    assert simulation.within.tolist() == [12, 2, 12, 12]
    assert simulation.success[:, 0].tolist() == [True, False, True, True]


def test_held_is_told_in_seconds_whatever_the_control_period(env_config):
    for control_dt, needed in ((0.02, 5), (0.05, 2)):
        config = env_config("reacher", *TASK, EXACT, STILL, f"env.control_dt={control_dt}")
        simulation = Simulation(config, 4, seed=0)
        simulation.reset()
        simulation.goal = np.zeros((4, 2))
        steps = []
        for _ in range(6):
            move(simulation, 0.0)
            steps.append(bool(simulation.success.all()))
        assert steps.index(True) + 1 == needed
        simulation.close()


def test_a_reset_forgets_what_was_held_in_its_rows_only(simulation):
    for _ in range(8):
        move(simulation, 0.0)
    simulation.reset(np.array([True, False, False, True]))
    assert simulation.within.tolist() == [0, 8, 8, 0]
    assert simulation.success[:, 0].tolist() == [False, True, True, False]


def test_a_success_ends_no_episode_of_a_task_that_goes_on(simulation):
    for step in range(1, 81):
        _, terminated, truncated = move(simulation, 0.0)
        assert not terminated.any()
        assert truncated.all() == (step == 80)
        assert simulation.success.all() == (step >= 5)


def test_rewards_are_summed_up_by_name_and_their_sum_is_the_reward(simulation):
    assert simulation.reward_terms == ("error", "held", "effort")
    total = np.zeros((4, 1))
    for _ in range(10):
        reward, _, _ = move(simulation, [0.0, 0.5, -0.5, 1.0])
        total += reward
    sums = dict(zip(simulation.reward_terms, simulation.episode_rewards.T, strict=True))
    np.testing.assert_allclose(sum(sums.values()), total[:, 0], rtol=1e-5)
    assert sums["held"][0] == pytest.approx(0.02 * sum(range(1, 11)))
    np.testing.assert_allclose(sums["effort"], [0.0, -0.25, -0.25, -1.0], rtol=1e-5)


def go(joint_position, goal, episode_length):
    """Go to the goal and stay; every second robot leaves it again, late."""
    action = (10 * (goal - joint_position)).clamp(-1, 1)
    leaves = (episode_length[:, 0] >= LEAVES_AT) & (torch.arange(len(goal)) % 2 == 1)
    return torch.where(leaves[:, None], torch.ones_like(action), action)


def test_an_episode_is_a_success_if_its_last_step_is_one_not_if_any_was(make):
    env = make(10, STILL)
    policy = TensorDictModule(go, in_keys=["joint_position", "goal", "episode_length"], out_keys=["action"])
    found = evaluate(policy, env, 10, seed=0)
    stayed = torch.arange(10) % 2 == 0
    assert torch.equal(found.success, stayed)
    assert (found.length[~stayed] == 80).all()  # they had been there, and left
    assert (found.length[stayed] < LEAVES_AT).all()  # when they had first been there for long enough
    assert (found.length[stayed] >= 5).all()
    assert (found.error[stayed] < 0.05).all()
    assert found.unit == "rad"
    assert found.summary()["distance_unit"] == "rad"


def test_specs_hold(make):
    check_env_specs(make(4))


def test_a_gymnasium_env_names_its_errors_and_shows_a_goal_of_joints():
    env = gymnasium.make("physai/Reacher-v0", render_mode="rgb_array", overrides=[*TASK, STILL])
    _, info = env.reset(seed=0)
    goal = env.unwrapped.simulation.goal[0]
    errors = dict(zip(("joint1", "joint2"), np.abs(goal), strict=True))  # the arm is at home
    assert info == {"is_success": False, **{name: pytest.approx(value, abs=1e-6) for name, value in errors.items()}}
    assert env.render().shape == (360, 480, 3)
    env.close()


def test_what_is_no_task_is_refused_by_name(env_config):
    part = "tests.tasks.test_interface.NoTask"
    config = env_config("reacher", "~env.task", f"+env.task={{_target_: {part}}}")
    with pytest.raises(UserError, match=rf"env\.task\._target_: {part} is not what is wanted here: it has no 'goal'"):
        Simulation(config, 1, seed=0)


class NoTask:
    """Takes what a task takes."""

    def __init__(self, *_: object) -> None: ...


def test_what_a_task_returns_stays_the_tasks_own(simulation):
    kept = np.ones(4, bool)
    simulation.task.success = lambda step: kept
    simulation.task.terminated = lambda step, success: kept
    simulation.step(np.zeros((4, 2)), restart=np.array([True, False, False, False]))
    assert kept.all()
    assert simulation.success[:, 0].tolist() == [False, True, True, True]
