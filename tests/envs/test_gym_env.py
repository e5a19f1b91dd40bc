import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import physai
from physai.envs.viewing import make_viewer
from physai.errors import UserError

IDS = ["physai/Reacher-v0", "physai/KukaReacher-v0"]


@pytest.fixture
def make():
    """Make an env, or a vector env, that is closed after the test."""
    made = []

    def make_env(name, num_envs=None, **options):
        if num_envs is None:
            made.append(gymnasium.make(name, **options))
        else:
            kind = "vector_entry_point"
            made.append(gymnasium.make_vec(name, num_envs=num_envs, vectorization_mode=kind, **options))
        return made[-1]

    yield make_env
    for env in made:
        env.close()


def in_fresh_python(script):
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def goal_pixels(image):
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return (green > 60) & (green > 1.5 * red) & (green > 1.5 * blue)


@pytest.mark.slow
@pytest.mark.parametrize("name", IDS)
def test_gymnasium_s_checker_passes_without_a_warning(make, name):
    env = make(name).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


@pytest.mark.parametrize("name", IDS)
def test_stable_baselines3_s_checker_passes_without_a_warning(make, name):
    env = make(name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env_sb3(env, warn=True)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("direction", [[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
def test_observations_stay_in_their_space_at_full_speed_to_the_end(make, name, direction):
    env = make(name, 16, overrides=["env.task.tolerance=1e-6"])
    env.reset(seed=0)
    action = np.tile(np.array(direction, dtype=np.float32), (16, 1))
    for _ in range(200):
        observation = env.step(action)[0]
        assert env.observation_space.contains(observation), observation
    assert env.observation_space.shape == (16, 8)


@pytest.mark.slow
def test_equal_seeds_give_equal_episodes_and_others_do_not(make):
    env = make(IDS[0])
    seen = []
    for seed in (3, 3, 4):
        first = env.reset(seed=seed)[0]
        seen.append(np.array([first, *(env.step(np.array([0.3, -0.6], np.float32))[0] for _ in range(20))]))
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.isclose(seen[0][0], seen[2][0]).all()
    assert not np.array_equal(env.reset()[0], env.reset()[0])  # episodes without a seed go on, not over again


def test_one_env_and_the_torchrl_env_play_the_same_episode(make):
    env = make(IDS[0])
    batched = physai.make_env("reacher", 1, overrides=["randomization=none"])
    env.reset(seed=0)
    batched.reset()
    batched.simulation.restore(env.unwrapped.simulation.snapshot())
    td = batched.base_env.fake_tensordict()
    random = np.random.default_rng(0)
    for _ in range(50):
        action = random.uniform(-1, 1, 2).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        td = batched.step(td.set("action", torch.from_numpy(action)[None]))["next"]
        for key, value in batched.simulation.physics.state().items():
            np.testing.assert_array_equal(env.unwrapped.simulation.physics.state()[key], value)
        np.testing.assert_allclose(td["observation"][0].numpy(), observation, rtol=0, atol=1e-6)
        assert float(td["reward"]) == pytest.approx(reward, abs=1e-6)
        assert (bool(td["terminated"]), bool(td["truncated"])) == (terminated, truncated)
    batched.close()


def test_info_tells_success_and_the_task_s_errors_by_name(make):
    env = make(IDS[0])
    observation, info = env.reset(seed=0)
    assert set(info) == {"is_success", "distance"}
    assert info["is_success"] is False
    assert info["distance"] == pytest.approx(np.linalg.norm(observation[4:6] - observation[6:8]), abs=1e-6)
    env.unwrapped.simulation.goal = observation[None, 4:6].astype(float)
    _, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert (terminated, truncated, info["is_success"]) == (True, False, True)
    assert reward == pytest.approx(10.0 - info["distance"])


def test_an_episode_is_truncated_after_200_steps(make):
    env = make(IDS[0], overrides=["env.task.tolerance=1e-6"])
    env.reset(seed=0)
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(200)]
    assert ends == [(False, False)] * 199 + [(False, True)]


@pytest.mark.parametrize("name", IDS)
def test_a_vector_env_restarts_an_episode_at_the_step_after_its_end(make, name):
    env = make(name, 4, overrides=["env.task.max_steps=5", "env.task.tolerance=1e-3"])
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.spec is not None
    first, info = env.reset(seed=0)
    assert first.shape == (4, 8)
    assert first.dtype == np.float32
    assert env.observation_space.contains(first)
    simulation = env.unwrapped.simulation
    simulation.goal = simulation.goal.copy()
    simulation.goal[1] = first[1, 4:6]  # the second robot is at its goal
    still = np.zeros((4, 2), np.float32)
    go = np.tile(np.array([0.5, 0.0], np.float32), (4, 1))
    terminations, truncations, observations, rewards, infos = [], [], [], [], []
    for step in range(1, 9):
        observation, reward, terminated, truncated, info = env.step(still if step == 1 else go)
        observations.append(observation)
        rewards.append(reward)
        terminations.append(terminated.tolist())
        truncations.append(truncated.tolist())
        infos.append(info)
    no = [False] * 4
    second, others = [False, True, False, False], [True, False, True, True]
    assert terminations == [second, *[no] * 7]
    # The second robot restarts in step 2 and plays 3 to 7; the others play 1 to 5 and restart in step 6.
    assert truncations == [no, no, no, no, others, no, second, no]
    assert rewards[0][1] > 9.9
    assert rewards[1][1] == 0
    assert (rewards[1][[0, 2, 3]] < 0).all()
    assert rewards[5][[0, 2, 3]].tolist() == [0, 0, 0]
    assert infos[0]["is_success"].tolist() == second
    assert set(info) == {"is_success", "distance"}
    assert info["distance"].shape == (4,)
    np.testing.assert_array_equal(observations[0][1, 6:], first[1, 4:6])  # the last observation of the old episode
    assert (observations[1][1, 6:] != observations[0][1, 6:]).all()  # the first of the new one
    assert (observations[1][1, 2:4] == 0).all()  # the action was not applied
    assert (observations[2][1, 2] > 0.05).all()
    np.testing.assert_array_equal(observations[4][0, 6:], first[0, 6:])
    assert (observations[5][0, 6:] != first[0, 6:]).all()
    for row in (0, 2, 3):
        np.testing.assert_array_equal(observations[1][row, 6:], first[row, 6:])


def test_a_vector_env_that_is_reset_when_episodes_are_over_plays_the_new_ones_from_its_first_step_on(make):
    env = make(IDS[0], 2, overrides=["env.task.max_steps=2", "env.task.tolerance=1e-6"])
    env.reset(seed=0)
    env.step(np.zeros((2, 2), np.float32))
    assert env.step(np.zeros((2, 2), np.float32))[3].all()
    first, _ = env.reset()
    observation, reward, *_ = env.step(np.zeros((2, 2), np.float32))
    np.testing.assert_array_equal(observation[:, 6:], first[:, 6:])
    assert (reward < 0).all()


def test_arrays_of_a_vector_env_are_not_changed_by_later_steps(make):
    env = make(IDS[0], 3, overrides=["env.task.max_steps=3"])
    kept = [env.reset(seed=0)[0]]
    copies = [kept[0].copy()]
    for _ in range(10):
        observation, reward, terminated, truncated, info = env.step(np.ones((3, 2), np.float32))
        for value in (observation, reward, terminated, truncated, *info.values()):
            kept.append(value)
            copies.append(np.array(value))
    for value, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(value, copy)


def test_a_row_of_a_vector_env_follows_its_seed(make):
    env = make(IDS[0], 3)
    first, again, other = (env.reset(seed=seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.isclose(first, other).all(-1).any()
    assert len(np.unique(first[:, 0])) == 3


@pytest.mark.parametrize("name", IDS)
def test_the_picture_shows_the_goal_where_it_is(make, name):
    env = make(name, render_mode="rgb_array")
    env.reset(seed=0)
    simulation = env.unwrapped.simulation
    centres = []
    for goal in ([0.4, 0.0], [0.0, 0.4], [-0.4, 0.0]):
        simulation.goal = np.array([goal])
        image = env.render()
        assert image.dtype == np.uint8
        assert image.shape == (360, 480, 3)
        rows, columns = goal_pixels(image).nonzero()
        assert len(rows) > 50
        centres.append((rows.mean(), columns.mean()))
    for one in range(3):
        for other in range(one):
            assert np.linalg.norm(np.subtract(centres[one], centres[other])) > 30


def test_looking_does_not_disturb_the_simulation(make):
    seen = []
    for mode in (None, "rgb_array"):
        env = make(IDS[0], render_mode=mode)
        env.reset(seed=0)
        steps = []
        for _ in range(5):
            steps.append(env.step(np.ones(2, np.float32))[0])
            env.render()
        seen.append(steps)
    np.testing.assert_array_equal(*seen)


def test_a_vector_env_renders_its_first_robot(make):
    env = make(IDS[0], 2, render_mode="rgb_array")
    env.reset(seed=0)
    (image,) = env.render()
    assert goal_pixels(image).sum() > 50


def test_importing_physai_registers_the_ids_and_imports_nothing_heavy():
    in_fresh_python(
        "import sys, physai, gymnasium\n"
        f"assert set({IDS}) <= set(gymnasium.registry)\n"
        "heavy = {'torch', 'torchrl', 'tensordict', 'pybullet', 'hydra', 'omegaconf', 'pydantic', 'rclpy', 'pandas'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )


@pytest.mark.slow
def test_a_gymnasium_env_needs_no_torchrl():
    in_fresh_python(
        "import sys, gymnasium, physai\n"
        "env = gymnasium.make('physai/Reacher-v0'); env.reset(seed=0); env.step(env.action_space.sample())\n"
        "envs = gymnasium.make_vec('physai/KukaReacher-v0', num_envs=2, vectorization_mode='vector_entry_point')\n"
        "envs.reset(seed=0); envs.step(envs.action_space.sample())\n"
        "assert not {'torchrl', 'tensordict'} & set(sys.modules)\n"
        "env.close(); envs.close()\n"
    )


@pytest.mark.slow
def test_nothing_of_a_viewer_is_imported_before_somebody_looks():
    in_fresh_python(
        "import sys, gymnasium, physai\n"
        "physai.make_env('reacher', num_envs=2).rollout(2)\n"
        "env = gymnasium.make('physai/Reacher-v0', render_mode='rgb_array'); env.reset(seed=0)\n"
        "assert 'physai.physics.viewer' not in sys.modules\n"
        "env.render()\n"
        "assert 'physai.physics.viewer' in sys.modules\n"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a screen")
def test_a_window_without_a_screen_is_refused_in_one_line_that_says_what_to_do(make, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    env = make(IDS[0])
    assert "human" not in env.unwrapped.metadata["render_modes"]
    with pytest.raises(UserError, match=r"no screen here \(DISPLAY is not set\): render images"):
        make_viewer(env.unwrapped.simulation, window=True)


@pytest.mark.parametrize("num_envs", [None, 3])
def test_a_robot_that_takes_positions_is_an_env_like_any_other(make, num_envs):
    env = make(IDS[0], num_envs, overrides=["env.robot.command=joint_position"])
    observation, _ = env.reset(seed=0)
    simulation = env.unwrapped.simulation
    before = simulation.state.joint_position
    for _ in range(20):
        observation = env.step(np.full(env.action_space.shape, 0.5, np.float32))[0]
    assert env.observation_space.contains(observation)
    speed = simulation.state.joint_velocity[:, 0]
    np.testing.assert_allclose(speed, 0.5 * simulation.spec.command_limit[0], rtol=0.1)
    assert (simulation.state.joint_position[:, 0] > before[:, 0]).all()


@pytest.mark.slow
def test_gymnasium_finds_the_env_by_the_module_in_its_name():
    in_fresh_python("import gymnasium; gymnasium.make('physai:physai/Reacher-v0').close()")
