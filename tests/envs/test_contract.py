"""Any engine and any task: what a simulation, its shells and the evaluation know of them is their contract."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict.nn import TensorDictModule
from torchrl.envs import check_env_specs

import physai
from physai.tasks import Reach
from physai.training.evaluation import evaluate

DUMMY = "env.physics={_target_: tests.physics.dummy.DummyPhysics}"


@pytest.fixture
def make_env():
    """Make an env that is closed after the test."""
    made = []

    def make(*overrides, num_envs=4):
        made.append(physai.make_env("reacher", num_envs, 0, ["randomization=none", *overrides]))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.mark.parametrize("command", ["joint_velocity", "joint_position"])
def test_another_engine_runs_under_the_torchrl_shell_and_the_evaluation(make_env, command):
    env = make_env(DUMMY, f"env.robot.command={command}", "env.task.max_steps=30")
    check_env_specs(env)
    still = TensorDictModule(lambda seen: torch.zeros(len(seen), 2), in_keys=["observation"], out_keys=["action"])
    evaluation = evaluate(still, env, 8, seed=0)
    assert len(evaluation.success) == 8
    assert (evaluation.length[~evaluation.success] == 30).all()
    td = env.reset()
    state = env.state()
    ends = []
    for _ in range(2):
        env.set_state(state)
        ends.append(env.step(td.clone().set("action", torch.ones(4, 2)))["next", "joint_position"])
    assert torch.equal(*ends)
    assert not torch.equal(ends[0], td["joint_position"])


def test_another_engine_runs_under_the_gymnasium_shell():
    env = gymnasium.make("physai/Reacher-v0", overrides=[DUMMY])
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=0)
    before = env.unwrapped.simulation.state.joint_position.copy()
    env.step(np.array([1.0, -0.5], np.float32))
    moved = env.unwrapped.simulation.state.joint_position - before
    np.testing.assert_allclose(moved, [[0.04, -0.02]])
    env.close()


class GoesOn(Reach):
    """As Reach, but that an episode goes on after a success, which asks for two steps at the goal."""

    def success(self, step):
        return step.held > 0.03

    def terminated(self, step, success):
        return np.zeros_like(success)


def test_success_is_no_termination_and_counts_at_the_last_step_of_an_episode(make_env):
    env = make_env(DUMMY, "env.task._target_=tests.envs.test_contract.GoesOn", "env.task.max_steps=10", num_envs=3)
    td = env.reset()
    simulation = env.simulation
    here = simulation.kinematics(td["joint_position"])[:, :2].double().numpy()
    simulation.goal = here + np.array([[0.0, 0.0], [0.0, 0.0], [9.0, 0.0]])  # two are there already, one never is
    leaves = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    seen = []
    for step in range(10):
        td = env.step(td.set("action", leaves if step > 2 else torch.zeros(3, 2)))["next"]
        seen.append(td["success"][:, 0].tolist())
    assert seen[:3] == [[False, False, False], [True, True, False], [True, True, False]]
    assert seen[-1] == [True, False, False]  # one has left its goal
    assert not td["terminated"].any()
    assert td["truncated"].all()


def test_the_evaluation_counts_the_first_success_of_an_episode_that_ends_with_one(make_env):
    env = make_env(DUMMY, "env.task._target_=tests.envs.test_contract.GoesOn", "env.task.tolerance=10.0")
    still = TensorDictModule(lambda seen: torch.zeros(len(seen), 2), in_keys=["observation"], out_keys=["action"])
    evaluation = evaluate(still, env, 4, seed=0)
    assert evaluation.success.all()
    assert evaluation.length.tolist() == [2] * 4
    assert evaluation.summary()["distance_unit"] == "m"


def test_each_term_of_the_reward_sums_up_under_its_name(make_env):
    env = make_env(DUMMY)
    assert env.simulation.reward_terms == ("distance", "success")
    td = env.rollout(20, break_when_any_done=False)
    total = td["next", "episode_rewards"].sum(-1)
    first = td["next", "episode_length"][..., 0] == 1
    torch.testing.assert_close(total[first], td["next", "reward"][..., 0][first])
