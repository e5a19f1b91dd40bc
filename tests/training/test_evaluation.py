import pytest
import torch

from physai.training.agent import Agent, make_evaluation_env
from physai.training.evaluation import Evaluation, evaluate
from tests.training.small import small_config


@pytest.fixture(scope="module")
def trained():
    config = small_config("collector=single")  # of whose robots evaluation could make use
    agent = Agent.build(config)
    agent.statistics.update(torch.randn(100, 8))
    env = make_evaluation_env(config, config.randomization, 8, seed=1)
    yield agent, env
    env.close()
    agent.close()


def result(successes: int, episodes: int) -> Evaluation:
    success = torch.arange(episodes) < successes
    return Evaluation(success, torch.full((episodes,), 10), torch.zeros(episodes), torch.zeros(episodes), "m")


def test_the_interval_is_wilsons():
    # Newcombe, "Two-sided confidence intervals for the single proportion", 1998, table I, method 3
    assert result(81, 263).success_ci == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert result(0, 20).success_ci == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert result(29, 29).success_ci == pytest.approx((0.8830, 1.0), abs=5e-5)


def test_steps_to_goal_count_only_goals_that_were_reached():
    evaluation = Evaluation(
        torch.tensor([True, False, True]), torch.tensor([10, 200, 30]), torch.zeros(3), torch.zeros(3), "m"
    )
    assert evaluation.summary()["steps_to_goal"] == 20
    assert result(0, 3).summary()["steps_to_goal"] is None


def test_evaluation_moves_neither_statistics_nor_random_numbers_nor_the_training_env(trained):
    agent, env = trained
    env.normalizer.load_state_dict(agent.statistics.normalizer.state_dict())
    statistics = {key: value.clone() for key, value in env.normalizer.state_dict().items()}
    random, state = torch.get_rng_state(), agent.collector.state()
    evaluate(agent.actor, env, 8, seed=5)
    assert all(torch.equal(value, statistics[key]) for key, value in env.normalizer.state_dict().items())
    assert torch.equal(random, torch.get_rng_state())
    after = agent.collector.state()
    for part in ("simulation", "transforms"):
        assert all(torch.equal(value, state["env"][part][key]) for key, value in after["env"][part].items())


@pytest.mark.slow
def test_equal_seeds_give_equal_goals_and_results_whatever_happened_before(trained):
    agent, env = trained
    first = evaluate(agent.actor, env, 20, seed=5)
    evaluate(agent.actor, env, 8, seed=6)
    second = evaluate(agent.actor, env, 20, seed=5)
    assert len(first.success) == 20
    for name in ("success", "length", "error", "episode_return"):
        assert torch.equal(getattr(first, name), getattr(second, name))


def test_only_the_first_episode_of_a_robot_counts(trained):
    agent, env = trained
    evaluation = evaluate(agent.actor, env, 8, seed=5)
    assert (evaluation.length[~evaluation.success] == 200).all()
    assert (evaluation.error[evaluation.success] < 0.05).all()
    assert (evaluation.error[~evaluation.success] >= 0.05).all()
