import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Independent, Normal
from torchrl.data import Composite, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.errors import UserError
from physai.policies import Critic, GaussianActor, ResidualActor, input_size


@pytest.fixture
def actor():
    torch.manual_seed(0)
    return GaussianActor(3, 2, ["x"], [8], "torch.nn.Tanh", initial_std=0.7)


def test_the_action_is_the_tanh_of_the_latent_sample_and_its_log_prob_is_that_of_the_normal(actor):
    with set_exploration_type(ExplorationType.RANDOM):
        data = actor(TensorDict({"x": torch.randn(64, 3)}, [64]))
    expected = Independent(Normal(actor.mean(data), 0.7), 1).log_prob(data["latent_action"])
    torch.testing.assert_close(data["action"], torch.tanh(data["latent_action"]))
    torch.testing.assert_close(data["action_log_prob"], expected)
    assert data["latent_action"].std() > 0.3


def test_the_deterministic_action_is_the_mean_and_draws_no_random_number(actor):
    data = TensorDict({"x": torch.randn(5, 3)}, [5])
    before = torch.get_rng_state()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        actor(data)
    torch.testing.assert_close(data["action"], torch.tanh(actor.mean(data)))
    assert torch.equal(before, torch.get_rng_state())


def test_the_probability_ratio_of_unchanged_weights_is_one_even_where_tanh_is_flat(actor):
    with torch.no_grad():
        actor.network[-1].bias += torch.tensor([20.0, -20.0])
    with set_exploration_type(ExplorationType.RANDOM):
        data = actor(TensorDict({"x": torch.randn(256, 3)}, [256]))
    assert (data["action"].abs() == 1.0).all()
    log_ratio = actor.get_dist(data).log_prob(data["latent_action"]) - data["action_log_prob"]
    assert log_ratio.abs().max() < 1e-4


def test_an_untrained_residual_actor_does_what_is_suggested():
    torch.manual_seed(0)
    actor = ResidualActor(5, 2, ["x", "features"], [8], "torch.nn.Tanh", initial_std=0.3)
    features = torch.randn(64, 4)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        data = actor(TensorDict({"x": torch.randn(64, 1), "features": features}, [64]))
    torch.testing.assert_close(data["action"], torch.tanh(features[:, 2:]), atol=0.05, rtol=0)
    seen = torch.cat([data["x"], features], dim=1)
    assert torch.equal(torch.jit.script(actor.deterministic())(seen), data["action"])


def test_a_residual_actor_adds_the_share_that_it_is_told_of_what_its_network_makes():
    torch.manual_seed(0)
    whole = ResidualActor(5, 2, ["x", "features"], [8], "torch.nn.Tanh", initial_std=0.3)
    tenth = ResidualActor(5, 2, ["x", "features"], [8], "torch.nn.Tanh", initial_std=0.3, scale=0.1)
    tenth.load_state_dict(whole.state_dict())
    data = TensorDict({"x": torch.randn(64, 1), "features": torch.randn(64, 4)}, [64])
    added = [actor.mean(data) - data["features"][:, 2:] for actor in (whole, tenth)]
    torch.testing.assert_close(added[1], 0.1 * added[0])


def test_a_residual_actor_must_see_the_features_last():
    with pytest.raises(UserError, match=r"policy\.actor\.in_keys: the last must be features"):
        ResidualActor(5, 2, ["features", "x"], [8], "torch.nn.Tanh", initial_std=0.3)


def test_the_critic_may_see_what_the_actor_does_not():
    critic = Critic(5, ["x", "physics_parameters"], [4], "torch.nn.ELU")
    data = critic(TensorDict({"x": torch.randn(7, 3), "physics_parameters": torch.randn(7, 2)}, [7]))
    assert data["state_value"].shape == (7, 1)


def test_an_unknown_input_key_is_named_with_the_nearest_right_one():
    spec = Composite(observation=Unbounded((4, 8)), features=Unbounded((4, 12)), shape=[4])
    assert input_size(spec, ["observation", "features"], "policy.actor") == 20
    with pytest.raises(UserError, match=r"policy.actor.in_keys.*'featurs'.*'features'"):
        input_size(spec, ["featurs"], "policy.actor")
