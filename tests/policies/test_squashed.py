"""Squashed actors: exact probabilities, noise where it belongs, and actions without it that script."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.policies import Critic, DeterministicActor, TanhGaussianActor


@pytest.fixture
def soft():
    torch.manual_seed(0)
    return TanhGaussianActor(3, 2, ["x"], [8], "torch.nn.ReLU")


@pytest.fixture
def deterministic():
    torch.manual_seed(0)
    return DeterministicActor(3, 2, ["x"], [8], "torch.nn.ReLU", exploration_std=0.5)


def states(count):
    return TensorDict({"x": torch.randn(count, 3)}, [count])


def act(actor, data, mode):
    with set_exploration_type(mode), torch.no_grad():
        return actor(data.clone())["action"]


def log_prob_of(actor, data, latent):
    """By the change of variables, in float64: log N(latent) - log(1 - tanh(latent)^2)."""
    with torch.no_grad():
        mean, log_std = actor.network(data["x"]).double().chunk(2, dim=-1)
    log_std = log_std.clamp(-5.0, 2.0)
    normal = -0.5 * ((latent - mean) / log_std.exp()) ** 2 - log_std - 0.5 * math.log(2 * math.pi)
    squash = 2 * (math.log(2.0) - latent - torch.nn.functional.softplus(-2 * latent))  # log(1 - tanh^2), exact
    return (normal - squash).sum(-1)


def test_the_log_probability_is_that_of_the_change_of_variables(soft):
    data = states(256)
    distribution = soft.get_dist(data)
    action = distribution.rsample()
    assert action.abs().max() < 1.0
    log_prob = distribution.log_prob(action)
    assert log_prob.shape == (256,)
    expected = log_prob_of(soft, data, torch.atanh(action.detach().double()))
    torch.testing.assert_close(log_prob.double(), expected, rtol=1e-3, atol=1e-3)
    log_prob.sum().backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in soft.parameters())


def test_the_log_probability_is_exact_where_tanh_is_flat(soft):
    with torch.no_grad():
        soft.network[-1].bias[:2] += torch.tensor([20.0, -20.0])  # of the means
    data = states(256)
    torch.manual_seed(5)
    distribution = soft.get_dist(data)
    action = distribution.rsample()
    assert (action.abs() == 1.0).all()
    log_prob = distribution.log_prob(action)
    torch.manual_seed(5)
    latent = soft.get_dist(data).base_dist.rsample().detach()
    torch.testing.assert_close(log_prob.double(), log_prob_of(soft, data, latent.double()), rtol=1e-5, atol=1e-4)
    log_prob.sum().backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in soft.parameters())


def test_the_deviation_depends_on_the_state_and_stays_in_bounds(soft):
    with torch.no_grad():
        soft.network[-1].weight[2:] *= 1000.0
        _, std = soft._mean_and_std(states(256))
    assert std.min() == pytest.approx(math.exp(-5.0))
    assert std.max() == pytest.approx(math.exp(2.0))


@pytest.mark.parametrize("name", ["soft", "deterministic"])
def test_without_exploration_the_action_is_that_of_the_scripted_network_and_draws_no_random_number(name, request):
    actor, data = request.getfixturevalue(name), states(64)
    before = torch.get_rng_state()
    scripted = torch.jit.script(actor.deterministic())
    action = act(actor, data, ExplorationType.DETERMINISTIC)
    assert torch.equal(torch.get_rng_state(), before)
    with torch.no_grad():
        torch.testing.assert_close(scripted(data["x"]), action)
    explored = act(actor, data, ExplorationType.RANDOM)
    assert not torch.equal(torch.get_rng_state(), before)
    assert not torch.equal(explored, action)
    assert torch.equal(act(actor, data, ExplorationType.DETERMINISTIC), action)


def test_an_exploring_soft_actor_draws_from_its_distribution(soft):
    data = states(64)
    torch.manual_seed(3)
    explored = act(soft, data, ExplorationType.RANDOM)
    torch.manual_seed(3)
    torch.testing.assert_close(explored, soft.get_dist(data).sample())


def test_noise_has_its_deviation_and_is_clipped(deterministic):
    with torch.no_grad():
        deterministic.network[-1].weight.zero_()
        deterministic.network[-1].bias.copy_(torch.tensor([0.0, 1.0]))
    explored = act(deterministic, states(4096), ExplorationType.RANDOM)
    assert explored.abs().max() == 1.0
    inside = explored[:, 0]  # around 0: bounds are two deviations away
    assert (inside.abs() < 0.5).float().mean() == pytest.approx(0.683, abs=0.03)
    assert (explored[:, 1] == 1.0).float().mean() == pytest.approx(0.317, abs=0.03)  # tanh(1) + 0.476 sd is at 1


def test_a_critic_that_sees_the_action_judges_it():
    torch.manual_seed(0)
    critic = Critic(5, ["x", "action"], [4], "torch.nn.ReLU")
    data = states(7).set("action", torch.zeros(7, 2))
    value = critic(data.clone())["state_action_value"]
    assert value.shape == (7, 1)
    assert "state_value" not in critic(data.clone())
    other = critic(data.clone().set("action", torch.ones(7, 2)))["state_action_value"]
    assert not torch.equal(value, other)
    assert Critic(3, ["x"], [4], "torch.nn.ReLU").out_keys == ["state_value"]
