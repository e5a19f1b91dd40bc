from operator import attrgetter

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv, check_env_specs

import physai
from physai.envs.robot_env import RobotEnv
from physai.errors import UserError
from physai.transforms import RunningStatistics

KEPT = ("goal", "episode_rewards", "error", "last_command", "within", "physics_parameters")
NAMES = ["reacher", "kuka_reacher"]
COMMANDS = ["joint_velocity", "joint_position"]
RANDOMIZATIONS = ["none", "default", "strong"]
every_env = [pytest.mark.parametrize("name", NAMES), pytest.mark.parametrize("randomization", RANDOMIZATIONS)]


@pytest.fixture
def make_env():
    """Make an env that is closed after the test."""
    made = []

    def make(name="reacher", randomization="strong", num_envs=8, seed=0, overrides=()):
        made.append(physai.make_env(name, num_envs, seed, [f"randomization={randomization}", *overrides]))
        return made[-1]

    yield make
    for env in made:
        env.close()


def actions(env, steps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(steps, *env.action_spec.shape, generator=generator) - 1


def play(env, td, steps, seed=0):
    """Step with random actions and partial resets; return all that was seen [N, T], and what comes next."""
    seen = []
    for action in actions(env, steps, seed):
        stepped, td = env.step_and_maybe_reset(td.set("action", action))
        seen.append(stepped.clone())
    return torch.stack(seen, 1), td


def learn(env, seen):
    """Renew the statistics, as a learner does."""
    RunningStatistics(env.normalizer, 0.01).update(seen["observation"])


def assert_equal(ours, theirs):
    assert set(ours.keys(True, True)) == set(theirs.keys(True, True))
    for key in ours.keys(True, True):
        assert torch.equal(ours[key], theirs[key]), key


def parametrized(test):
    for mark in every_env:
        test = mark(test)
    return test


def test_a_policy_that_is_being_learnt_can_drive_a_rollout(make_env):
    policy = TensorDictModule(torch.nn.Linear(8, 2), in_keys=["observation"], out_keys=["action"])
    rollout = make_env().rollout(3, policy, break_when_any_done=False)
    assert rollout["action"].requires_grad


@parametrized
def test_specs_hold(make_env, name, randomization):
    check_env_specs(make_env(name, randomization))


@parametrized
def test_a_step_of_zeros_is_the_one_that_torchrl_makes(make_env, name, randomization):
    env = make_env(name, randomization)
    ours, theirs = env.fake_tensordict(), TransformedEnv.fake_tensordict(env)
    assert_equal(ours, theirs)
    assert ours.batch_size == theirs.batch_size == ours["next"].batch_size


@pytest.mark.parametrize("name", NAMES)
def test_specs_of_the_bare_env_hold(env_config, name):
    env = RobotEnv(env_config(name), 4)
    check_env_specs(env)
    env.close()


@parametrized
def test_a_partial_reset_leaves_the_other_rows_of_all_keys_bit_identical(make_env, name, randomization):
    env = make_env(name, randomization, overrides=["env.task.tolerance=1e-6"])
    _, td = play(env, env.reset(), 20)
    before, state = td.clone(), {key: value.clone() for key, value in env.state()["simulation"].items()}
    mask = torch.zeros(8, 1, dtype=torch.bool)
    mask[[0, 3, 6]] = True
    rows = mask[:, 0]
    after = env.reset(td.clone().set("_reset", mask))
    for key in after.keys(True, True):
        assert torch.equal(after[key][~rows], before[key][~rows]), key
    for key in ("joint_position", "goal", "observation"):
        assert (after[key][rows] != before[key][rows]).any(-1).all(), key
    assert (after["episode_length"][rows] == 0).all()
    assert (after["episode_rewards"][rows] == 0).all()
    assert not after["success"][rows].any()
    for key, value in env.state()["simulation"].items():
        if key == "delay.commands":  # the steps come first, as many as the longest delay of all needs
            count = len(state[key])
            assert torch.equal(value[:count, ~rows], state[key][:, ~rows])
        elif key != "generator":
            assert torch.equal(value[~rows], state[key][~rows]), key


@pytest.mark.parametrize("name", NAMES)
def test_rows_that_were_never_reset_go_the_same_way_whatever_happens_to_the_others(make_env, name):
    disturbed, quiet = (make_env(name, overrides=["env.task.tolerance=1e-6"]) for _ in range(2))
    td, quiet_td = disturbed.reset(), quiet.reset()
    kept = torch.tensor([1, 2, 7])
    for step, action in enumerate(actions(quiet, 100)):
        if step % 5 == 3:
            mask = torch.ones(8, 1, dtype=torch.bool)
            mask[kept] = False
            mask[step % 8] = False
            td = disturbed.reset(td.set("_reset", mask))
        td = disturbed.step(td.set("action", action))["next"]
        quiet_td = quiet.step(quiet_td.set("action", action))["next"]
        for key in ("state.joint_position", "state.joint_velocity", *KEPT):
            ours, theirs = (attrgetter(key)(env.simulation)[kept.numpy()] for env in (disturbed, quiet))
            np.testing.assert_array_equal(ours, theirs, err_msg=f"{step} {key}")
        assert torch.equal(td["reward"][kept], quiet_td["reward"][kept])


@pytest.mark.slow
@parametrized
def test_a_rollout_of_staggered_episodes_is_consistent(make_env, name, randomization):
    env = make_env(name, randomization, overrides=["env.task.max_steps=13", "env.task.tolerance=0.1"])
    td = env.reset()
    for step in range(6):  # set the rows' clocks apart
        mask = torch.zeros(8, 1, dtype=torch.bool)
        mask[step] = True
        td = env.step(td.set("action", torch.zeros(8, 2)))["next"].exclude("reward")
        td = env.reset(td.set("_reset", mask))
    seen, _ = play(env, td, 80)
    done = seen["next", "done"][..., 0]
    assert torch.equal(done, (seen["next", "terminated"] | seen["next", "truncated"])[..., 0])
    assert not (seen["next", "terminated"] & seen["next", "truncated"]).any()
    assert not seen["done"].any()
    ends = [row.nonzero()[:, 0].tolist() for row in done]
    assert len({tuple(end) for end in ends}) > 4  # staggered indeed
    going, over = ~done[:, :-1], done[:, :-1]
    follows = seen[:, 1:]
    for key in follows.exclude("next", "action").keys():  # noqa: SIM118 (iterating a TensorDict gives its rows)
        assert torch.equal(follows[key][going], seen["next", key][:, :-1][going]), key
    assert (follows["episode_length"][over] == 0).all()
    assert (seen["next", "episode_length"] == seen["episode_length"] + 1).all()
    assert seen["next", "episode_length"].max() == 13
    assert torch.equal(seen["next", "truncated"], (seen["next", "episode_length"] == 13) & ~seen["next", "terminated"])
    assert not torch.isclose(follows["goal"][over], seen["goal"][:, :-1][over]).all(-1).any()
    torch.testing.assert_close(
        seen["next", "episode_rewards"].sum(-1, keepdim=True),
        seen["episode_rewards"].sum(-1, keepdim=True) + seen["next", "reward"],
        rtol=0,
        atol=1e-5,
    )
    assert torch.equal(seen["next", "success"], seen["next", "terminated"])  # a reached goal ends the episode
    assert not seen["success"].any()


def test_an_episode_is_truncated_after_200_steps(make_env):
    env = make_env(num_envs=2, overrides=["env.task.tolerance=1e-6"])
    td = env.rollout(300, break_when_any_done=True)
    assert td.shape == (2, 200)
    assert td["next", "truncated"][:, -1].all()
    assert not td["next", "terminated"].any()


@pytest.mark.parametrize("name", NAMES)
def test_equal_seeds_give_equal_rollouts_and_others_do_not(make_env, name):
    rollouts = []
    for seed in (5, 5, 6):
        env = make_env(name, seed=seed, overrides=["env.task.max_steps=20"])
        rollouts.append(play(env, env.reset(), 50)[0])
    assert_equal(rollouts[0], rollouts[1])
    for key in ("joint_position", "goal", "physics_parameters", "observation"):
        assert not torch.isclose(rollouts[0][key], rollouts[2][key]).all(), key


def test_setting_the_seed_again_starts_the_same_episodes_again(make_env):
    env = make_env(overrides=["env.task.max_steps=20"])
    rollouts = []
    for seed in (7, 8, 7):
        env.set_seed(seed)
        rollouts.append(play(env, env.reset(), 30)[0])
    assert_equal(rollouts[0], rollouts[2])
    assert not torch.isclose(rollouts[0]["goal"], rollouts[1]["goal"]).all()


def test_the_global_random_numbers_of_torch_play_no_part(make_env):
    rollouts = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        env = make_env(overrides=["env.task.max_steps=20"])
        rollouts.append(play(env, env.reset(), 30)[0])
        torch.rand(1)
    assert_equal(rollouts[0], rollouts[1])


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
@parametrized
def test_a_restored_state_continues_bit_for_bit_with_noise_and_delay(make_env, name, randomization, command):
    carried_over = "env.start.carried_over=0.5"
    steps = ["env.task.max_steps=40", "env.task.tolerance=0.1", f"env.robot.command={command}", carried_over]
    options = {"overrides": steps}
    original = make_env(name, randomization, seed=0, **options)
    seen, td = play(original, original.reset(), 45)
    learn(original, seen)
    _, td = play(original, td, 8, seed=1)
    state = original.state()
    restored = make_env(name, randomization, seed=99, **options)
    play(restored, restored.reset(), 3)
    restored.set_state(state)
    carried = td.clone()
    expected, _ = play(original, td, 90, seed=2)
    found, _ = play(restored, carried, 90, seed=2)
    assert expected["next", "done"].any()
    assert_equal(found, expected)


def test_a_state_that_was_taken_can_be_gone_back_to_after_any_detour(make_env):
    env = make_env(overrides=["env.task.max_steps=10"])
    seen, first = play(env, env.reset(), 15)
    first = first.clone()
    start = env.state()
    learn(env, seen)
    _, second = play(env, first.clone(), 15, seed=1)
    second = second.clone()
    later = env.state()
    expected, _ = play(env, second.clone(), 15, seed=2)
    env.set_state(start)
    play(env, first.clone(), 15, seed=3)
    env.set_state(later)
    found, _ = play(env, second.clone(), 15, seed=2)
    assert_equal(found, expected)


def test_a_seed_gives_the_same_goals_to_robots_one_after_the_other_as_side_by_side(make_env):
    home = {"randomization": "none", "overrides": ["env.start.spread=[0.0,0.0]"]}
    together, alone = make_env(num_envs=50, **home), make_env(num_envs=1, **home)
    for env in (together, alone):
        env.set_seed(3)
    goals = together.reset()["goal"]
    assert torch.equal(goals, torch.cat([alone.reset()["goal"] for _ in range(50)]))
    assert not together.simulation.state.joint_position.any()


def test_make_env_works_as_the_readme_shows():
    env = physai.make_env("reacher", num_envs=8, seed=0, overrides=["randomization=none"])
    td = env.rollout(3)
    assert isinstance(td, TensorDict)
    assert td.shape == (8, 3)
    assert td["observation"].shape == (8, 3, 8)
    assert td["observation"].dtype == torch.float32
    assert td["action"].shape == (8, 3, 2)
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("randomization=stron", ["stron", "did you mean 'strong'?"]),
        ("env.control_d=0.01", ["env.control_d", "did you mean 'env.control_dt'?"]),
        ("env.task.tolerence=0.1", ["env.task.tolerence", "did you mean 'env.task.tolerance'?"]),
        ("randomisation=none", ["randomisation", "did you mean 'randomization'?"]),
        ("env.control_dt=fast", ["control_dt", "number", "'fast'"]),
        ("env.robot.command_limit=[1.0,-1.0]", ["command_limit", "greater than 0", "-1.0"]),
        ("env.task.max_steps=0", ["max_steps", "greater than 0", "0"]),
        ("env.robot.joints=[joint1,joint3]", ["joint3", "did you mean 'joint"]),
        ("normalization.clip=0", ["clip", "greater than 0"]),
        ("env.robot.command=joint_effort", ["command", "'joint_velocity' or 'joint_position'", "'joint_effort'"]),
        ("env.start.carried_over=2", ["carried_over", "less than or equal to 1", "2"]),
        ("nonsense", ["nonsense"]),
    ],
)
def test_a_wrong_override_is_refused_in_one_line_with_the_nearest_name(override, words):
    with pytest.raises(UserError) as caught:
        physai.make_env("reacher", num_envs=2, overrides=[override])
    assert len(str(caught.value).splitlines()) == 1
    for word in words:
        assert word in str(caught.value)


def test_an_unknown_env_is_refused_with_the_nearest_name():
    with pytest.raises(UserError, match="kuka_reacher"):
        physai.make_env("kuka_reachr", num_envs=2)
