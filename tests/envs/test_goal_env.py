"""Envs with exchangeable goals: what hindsight replay and users of panda-gym expect of them."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import physai  # noqa: F401 (registers the ids)
from physai.envs.goal_env import GoalGymEnv
from physai.errors import UserError

GOALS = ["Reacher", "PandaReach", "PandaPose"]


@pytest.fixture
def make():
    made = []

    def make(name, *overrides):
        made.append(gymnasium.make(f"physai/{name}Goal-v0", overrides=["physics=mujoco", *overrides]))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", GOALS)
def test_gymnasium_s_checker_passes(make, name):
    check_env(make(name).unwrapped, skip_render_check=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", GOALS)
def test_a_goal_is_achieved_where_the_end_effector_is_and_rewards_can_be_computed_for_many(make, name):
    env = make(name)
    observation, _ = env.reset(seed=0)
    compute = env.unwrapped.compute_reward
    achieved, desired = observation["achieved_goal"], observation["desired_goal"]
    assert compute(achieved, achieved, {}) == 0.0
    assert compute(achieved, desired, {}) == -1.0
    both = compute(np.stack([achieved, achieved]), np.stack([achieved, desired]), [{}, {}])
    np.testing.assert_array_equal(both, [0.0, -1.0])
    after, reward, _, _, info = env.step(env.action_space.sample())
    assert reward == compute(after["achieved_goal"], after["desired_goal"], info)
    place = len(after["achieved_goal"][:3])
    distance = np.linalg.norm(after["achieved_goal"][:place] - after["desired_goal"][:place])
    assert distance == pytest.approx(info["distance"], abs=1e-5)


@pytest.mark.slow
def test_a_pose_with_the_opposite_quaternion_is_the_same_goal(make):
    env = make("PandaPose")
    observation, _ = env.reset(seed=0)
    pose = observation["achieved_goal"]
    opposite = np.concatenate([pose[:3], -pose[3:]])
    turned = np.concatenate([pose[:3], pose[[4, 3, 6, 5]]])
    compute = env.unwrapped.compute_reward
    assert compute(pose, opposite, {}) == 0.0
    assert compute(pose, turned, {}) == -1.0


@pytest.mark.slow
def test_hindsight_replay_of_stable_baselines3_learns_from_it(make):
    from stable_baselines3 import SAC, HerReplayBuffer

    buffer = {"n_sampled_goal": 4, "goal_selection_strategy": "future"}
    learner = SAC(
        "MultiInputPolicy",
        make("PandaReach", "env.task.max_steps=40"),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs=buffer,
        learning_starts=100,
        batch_size=16,
        seed=0,
    )
    learner.learn(120)
    assert learner.replay_buffer.size() == 120


def test_goals_that_cannot_be_exchanged_are_refused():
    task = ("~env.task", "+env.task={_target_: tests.tasks.hold.Hold, hold: 0.1, max_steps: 80}")
    with pytest.raises(UserError, match="'reacher' has goals of joint_position"):
        GoalGymEnv("reacher", overrides=task)
