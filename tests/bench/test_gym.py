"""The measurement of the Gymnasium envs is fair, runs, and shows both sides."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from rich.console import Console

from physai.bench import gym
from physai.bench.gym import HandWrittenReacher


@pytest.fixture
def by_hand(reacher):
    env = HandWrittenReacher(reacher)
    yield env
    env.close()


@pytest.mark.filterwarnings("ignore::UserWarning")  # it is minimal
def test_the_env_written_by_hand_is_a_gymnasium_env(by_hand):
    check_env(by_hand)


def test_the_env_written_by_hand_is_the_same_task_as_physai_s(by_hand):
    ours = gymnasium.make(gym.NAME, overrides=["env.start.spread=[0.0,0.0]"])
    simulation = ours.unwrapped.simulation
    by_hand.spread = [0.0, 0.0]
    by_hand.reset(seed=0)
    ours.reset(seed=0)
    simulation.goal = np.array([[by_hand.goal_x, by_hand.goal_y]], np.float32)
    random = np.random.default_rng(0)
    for _ in range(10):
        action = random.uniform(-1, 1, 2).astype(np.float32)
        observation, reward, terminated, truncated, _ = by_hand.step(action)
        found = ours.step(action)
        np.testing.assert_allclose(found[0], observation, rtol=0, atol=0.1)  # friction is physai's alone
        assert found[1] == pytest.approx(reward, abs=0.03)
        assert found[2:4] == (terminated, truncated)
    ours.close()


@pytest.mark.slow
def test_both_comparisons_are_measured_and_shown(monkeypatch):
    for name, value in {"ROBOTS": 3, "ROUNDS": 2, "STEPS": 50, "STEPS_OF_ALL": 5}.items():
        monkeypatch.setattr(gym, name, value)
    speeds = gym.measure_gym(seed=0)
    assert [len(sides) for sides in speeds] == [2, 2]
    assert all(min(sides) > 0 for sides in speeds)
    console = Console(width=120, record=True)
    console.print(gym.gym_table(*speeds))
    shown = console.export_text()
    for part in ("one robot", "by hand", "3 robots", "DummyVecEnv", "ratio"):
        assert part in shown
