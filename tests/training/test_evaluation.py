import copy

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from physai.envs.make import make
from physai.training.agent import Agent, make_evaluation_env
from physai.training.evaluation import Evaluation, evaluate, evaluate_in_a_row, wilson
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
    success, zeros = torch.arange(episodes) < successes, torch.zeros(episodes)
    return Evaluation(success, success, ~success, torch.full((episodes,), 10), zeros, zeros, zeros, zeros, "m")


def test_the_interval_is_wilsons():
    # Newcombe, "Two-sided confidence intervals for the single proportion", 1998, table I, method 3
    assert result(81, 263).success_ci == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert result(0, 20).success_ci == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert result(29, 29).success_ci == pytest.approx((0.8830, 1.0), abs=5e-5)


def test_steps_to_goal_count_only_goals_that_were_reached():
    reached = torch.tensor([True, False, True])
    evaluation = Evaluation(reached, reached, ~reached, torch.tensor([10, 200, 30]), *torch.zeros(4, 3), "m")
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


class Swing(TensorDictModuleBase):
    """Takes the arm along Jᵀe to its goal; there it stays, or shakes and turns away after 6 s."""

    def __init__(self, stays: bool) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["features"], ["action"]
        self.stays = stays
        self.steps = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.steps += 1
        fine = tensordict["features"][:, -2:]  # tanh of Jᵀe in units of the tolerance
        if not self.stays:
            fine = torch.sign(fine) if self.steps < 300 else torch.ones_like(fine)
        return tensordict.set("action", fine)


def swinging(env, stays):
    return evaluate(Swing(stays), env, 64, seed=3)


@pytest.fixture(scope="module")
def ideal():
    with_time = make("reacher", 64, overrides=["randomization=none", "env.task.max_steps=400"])
    yield with_time
    with_time.close()


@pytest.fixture(scope="module")
def swung(ideal):
    """How an arm does that stays, and one that leaves again."""
    return swinging(ideal, stays=True), swinging(ideal, stays=False)


def test_who_touches_the_goal_and_leaves_it_again_has_success_and_has_not_settled(swung):
    stays, leaves = swung
    assert stays.success_rate > 0.9
    assert leaves.success_rate > 0.9
    assert stays.settled_rate > 0.9
    assert leaves.settled_rate < 0.5
    low, high = leaves.settled_ci
    assert low <= leaves.settled_rate <= high


def test_watching_on_after_a_success_changes_nothing_of_what_came_before(swung):
    # A robot whose episode is over in the sense of the task is judged there: steps, error and return are of its end.
    leaves = swung[1]
    assert (leaves.length[leaves.success] < 300).all()
    assert (leaves.error[leaves.success] < 0.05).all()


def test_jerky_commands_show_in_the_change_of_action_and_in_the_acceleration(swung):
    smooth, jerky = (one.summary() for one in swung)
    for figure in ("action_change_p99", "acceleration_p99"):
        assert jerky[figure] > 5 * smooth[figure]
    assert jerky["action_change_p99"] == pytest.approx(2.0)  # from one end to the other


def test_who_bends_into_itself_has_crashed_and_has_neither_success_nor_settled():
    env = make("panda_reach", 32, overrides=["physics=mujoco", "randomization=none"])
    bend = TensorDictModule(lambda features: torch.ones(len(features), 7), ["features"], ["action"])
    bent = evaluate(bend, env, 32, seed=3)
    env.close()
    assert 0.1 < bent.summary()["crashed_rate"] <= 1.0
    assert not (bent.crashed & (bent.success | bent.settled)).any()


@pytest.mark.slow
def test_in_a_row_each_robot_begins_where_it_ended_and_every_goal_counts(env_config):
    config = env_config("reacher")
    start = config.start.model_copy(update={"carried_over": 1.0})
    env = make("reacher", 16, overrides=["randomization=none", "env.start.carried_over=1.0"])
    assert env.simulation.config.start == start
    moved = []
    began = env.simulation._begin

    def begin(rows, ended, parameters=None):
        before = copy.deepcopy(env.simulation.state.joint_position) if env.simulation.started.all() else None
        began(rows, ended, parameters)
        if before is not None:
            moved.append(abs(env.simulation.state.joint_position - before).max())

    env.simulation._begin = begin
    success, near_limit = evaluate_in_a_row(Swing(stays=True), env, 5, seed=3)
    env.close()
    assert success.shape == (16, 5)
    assert success.double().mean() > 0.9
    assert len(moved) >= 5
    assert max(moved) < 1e-6
    assert near_limit[0] == 0.0  # it turns without end


class Push(TensorDictModuleBase):
    """Turns every joint one way."""

    in_keys, out_keys = ["features"], ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", torch.tensor([[1.0, 0.0]]).expand(len(tensordict["features"]), 2))


@pytest.mark.slow
def test_time_near_a_joint_limit_shows_for_the_joint_that_is_there():
    env = make("kuka_reacher", 4, overrides=["randomization=none", "env.start.carried_over=1.0"])
    _, near_limit = evaluate_in_a_row(Push(), env, 4, seed=3)
    env.close()
    assert near_limit[0] > 0.5
    assert near_limit[1] == 0.0


def test_failures_of_one_robot_widen_the_interval_for_they_depend_on_each_other():
    spread, one_robot = torch.ones(2, 40, 40, dtype=torch.bool)
    spread[:, 0] = False
    one_robot[0] = False
    assert spread.double().mean() == one_robot.double().mean()
    narrow, wide = wilson(spread), wilson(one_robot)
    assert wide[1] - wide[0] > 3 * (narrow[1] - narrow[0])
