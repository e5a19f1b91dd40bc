"""Advantages, targets and losses against numbers worked out by hand."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.algorithms import NonFiniteError, OnPolicy
from physai.config import validate
from physai.errors import UserError
from physai.policies import Critic, GaussianActor
from physai.training.agent import Agent
from physai.training.config import TrainConfig
from tests.algorithms.assemble import assemble
from tests.composed import composed

GAMMA, LAMBDA = 0.9, 0.8


class ReadValue(TensorDictModuleBase):
    """A critic whose opinion is written in the data."""

    in_keys = ("value_in",)
    out_keys = ("state_value",)

    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(()))

    def forward(self, data):
        return data.set("state_value", data["value_in"] * self.gain)


def build(actor, critic, frames, *overrides):
    node = composed(f"collector.frames_per_batch={frames}", f"algo.minibatch_size={frames}", *overrides)
    return assemble(node.algo, actor, critic, frames)


def test_advantages_bootstrap_on_truncation_and_not_on_termination():
    # one robot, five steps: step 1 ends by termination, step 3 by truncation, the rest run on
    reward = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0])
    value = torch.tensor([0.5, 0.4, 0.3, 0.2, 0.1])
    next_value = torch.tensor([0.4, 7.0, 0.2, 0.6, 0.9])  # at the ends: the value of the true last state
    terminated = torch.tensor([False, True, False, False, False])
    truncated = torch.tensor([False, False, False, True, False])
    delta = [
        1 + GAMMA * 0.4 - 0.5,
        2 - 0.4,  # terminated: nothing comes after
        3 + GAMMA * 0.2 - 0.3,
        4 + GAMMA * 0.6 - 0.2,  # truncated: the future is only unseen
        5 + GAMMA * 0.9 - 0.1,
    ]
    expected = [
        delta[0] + GAMMA * LAMBDA * delta[1],
        delta[1],
        delta[2] + GAMMA * LAMBDA * delta[3],
        delta[3],
        delta[4],
    ]

    def column(x):
        return x[None, :, None]

    after = {
        "value_in": column(next_value),
        "reward": column(reward),
        "terminated": column(terminated),
        "truncated": column(truncated),
        "done": column(terminated | truncated),
    }
    batch = TensorDict({"value_in": column(value), "next": TensorDict(after, [1, 5])}, [1, 5])
    actor = GaussianActor(1, 1, ["value_in"], [2], "torch.nn.Tanh", 1.0)
    algorithm = build(actor, ReadValue(), 5, f"algo.advantage.gamma={GAMMA}", f"algo.advantage.lmbda={LAMBDA}")
    with torch.no_grad():
        algorithm.advantage(batch)
    torch.testing.assert_close(batch["advantage"][0, :, 0], torch.tensor(expected))
    torch.testing.assert_close(batch["value_target"][0, :, 0], torch.tensor(expected) + value)


def test_the_ppo_objective_clips_the_ratio_of_the_latent_actions():
    actor = GaussianActor(1, 1, ["x"], [2], "torch.nn.Tanh", initial_std=1.0)
    with torch.no_grad():
        for parameter in actor.network.parameters():
            parameter.zero_()  # mean 0, standard deviation 1
    latent = torch.tensor([[0.0], [1.0], [2.0]])
    new_log_prob = [-0.5 * x**2 - 0.5 * math.log(2 * math.pi) for x in (0.0, 1.0, 2.0)]
    log_ratio = [0.5, -0.5, 0.1]
    advantage = [2.0, -1.0, 3.0]
    # ratio 1.65 clipped to 1.2 (gain), 0.61 clipped up to 0.8 (loss is the worse), 1.105 inside
    expected = -(2 * 1.2 - 1 * 0.8 + 3 * math.exp(0.1)) / 3
    data = TensorDict(
        {
            "x": torch.zeros(3, 1),
            "latent_action": latent,
            "action_log_prob": torch.tensor(new_log_prob) - torch.tensor(log_ratio),
            "advantage": torch.tensor(advantage)[:, None],
            "value_target": torch.tensor([[1.0], [2.0], [3.0]]),
            "state_value": torch.zeros(3, 1),
        },
        [3],
    )
    critic = Critic(1, ["x"], [2], "torch.nn.Tanh")
    with torch.no_grad():
        for parameter in critic.network.parameters():
            parameter.zero_()
    overrides = [
        "algo.loss.normalize_advantage=false",
        "algo.loss.clip_epsilon=0.2",
        "algo.loss.critic_coeff=0.5",
    ]
    losses = build(actor, critic, 3, *overrides).loss(data)
    assert losses["loss_objective"].item() == pytest.approx(expected, rel=1e-5)
    assert losses["loss_critic"].item() == pytest.approx(0.5 * (1 + 4 + 9) / 3, rel=1e-5)


def small_batch(reward=1.0):
    torch.manual_seed(1)
    actor = GaussianActor(2, 1, ["x"], [4], "torch.nn.Tanh", 1.0)
    critic = Critic(2, ["x"], [4], "torch.nn.Tanh")
    batch = TensorDict({"x": torch.randn(4, 8, 2)}, [4, 8])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        actor(batch)
    false = torch.zeros(4, 8, 1, dtype=torch.bool)
    after = {"x": torch.randn(4, 8, 2), "reward": torch.full((4, 8, 1), reward)}
    after |= {"done": false, "terminated": false.clone(), "truncated": false.clone()}
    return actor, critic, batch.set("next", TensorDict(after, [4, 8]))


def test_an_update_changes_the_weights_and_reports_what_matters():
    actor, critic, batch = small_batch()
    algorithm = build(actor, critic, 32)
    before = [parameter.clone() for parameter in (*actor.parameters(), *critic.parameters())]
    metrics = algorithm.update(batch)
    after = [*actor.parameters(), *critic.parameters()]
    assert all(not torch.equal(old, new) for old, new in zip(before, after, strict=True))
    assert {
        "loss_objective",
        "loss_critic",
        "kl_approx",
        "clip_fraction",
        "entropy",
        "explained_variance",
        "lr",
    } <= set(metrics)


def test_no_step_follows_a_gradient_longer_than_its_largest_norm():
    actor, critic, batch = small_batch()
    algorithm = build(actor, critic, 32, "algo.max_grad_norm=1e-3")
    assert algorithm.update(batch)["grad_norm"] > 1e-2
    followed = [parameter.grad for parameter in algorithm.loss.parameters()]
    assert float(torch.cat([gradient.flatten() for gradient in followed]).norm()) == pytest.approx(1e-3, rel=1e-3)


def test_the_learning_rate_falls_along_its_schedule():
    actor, critic, batch = small_batch()
    algorithm = build(actor, critic, 32, "total_frames=64", "algo.optimizer.lr=0.01", "algo.scheduler.end_factor=0.5")
    rates = [algorithm.update(batch.clone())["lr"] for _ in range(3)]
    assert rates == pytest.approx([0.01, 0.0075, 0.005])


@pytest.mark.parametrize(("target", "rates"), [(1e6, [1e-4, 1.5e-4, 2.25e-4]), (1e-3, [1e-3, 1e-3 / 1.5, 1e-3 / 2.25])])
def test_the_learning_rate_follows_from_how_far_the_policy_moves_where_that_is_asked(target, rates):
    actor, critic, batch = small_batch()
    batch["action_log_prob"] = batch["action_log_prob"] + 1.0  # as if the policy had moved by 1 nat since
    overrides = ["algo.scheduler=null", f"algo.optimizer.lr={rates[0]}", f"algo.target_kl={target}"]
    algorithm = build(actor, critic, 32, *overrides)
    assert [algorithm.update(batch.clone())["lr"] for _ in range(3)] == pytest.approx(rates)
    for _ in range(10):
        last = algorithm.update(batch.clone())["lr"]
    assert last == pytest.approx(1e-3 if target > 1 else 1e-5)  # and no further


def test_a_loss_that_does_not_say_how_far_the_policy_moves_cannot_be_followed():
    actor, critic, _ = small_batch()
    with pytest.raises(UserError, match="target_kl: this loss does not say how far the policy moves"):
        build(actor, critic, 32, "algo=a2c", "collector.frames_per_batch=32", "+algo.target_kl=0.01")


def test_with_symmetry_each_minibatch_comes_with_its_mirror_image():
    actor, critic, batch = small_batch()
    node = composed("collector.frames_per_batch=32", "algo.minibatch_size=8", "algo.symmetry=true").algo

    def mirror(frames):
        assert "next" not in frames.keys()  # noqa: SIM118 (of a TensorDict)
        return frames.select("x", "latent_action").apply(torch.neg)

    algorithm, seen = assemble(node, actor, critic, 32, mirror=mirror), []
    algorithm.loss.register_forward_pre_hook(lambda _, given: seen.append(given[0].clone()))
    algorithm.update(batch)
    assert len(seen) == 2 * 4 * node.epochs
    for own, image in zip(seen[::2], seen[1::2], strict=True):
        assert len(own) == 8
        for name in ("x", "latent_action"):
            assert torch.equal(image[name], -own[name])
        for name in ("advantage", "action_log_prob", "value_target"):
            assert torch.equal(image[name], own[name])


def test_there_is_no_symmetry_without_legs_and_none_with_a_memory():
    with pytest.raises(UserError, match=r"algo\.symmetry: robot 'planar_arm' stands on no legs: it has no other side"):
        Agent.build(validate(TrainConfig, composed("algo.symmetry=true")))
    with pytest.raises(UserError, match=r"algo\.symmetry: what an actor remembers has no mirror image"):
        Agent.build(validate(TrainConfig, composed("algo.symmetry=true", "policy=gru")))


def test_a_loss_that_is_not_finite_stops_before_the_step_and_hands_over_the_batch():
    actor, critic, batch = small_batch(reward=float("nan"))
    algorithm = build(actor, critic, 32)
    before = [parameter.clone() for parameter in actor.parameters()]
    with pytest.raises(NonFiniteError, match="loss") as caught:
        algorithm.update(batch)
    assert caught.value.batch.numel() == 32
    assert all(torch.equal(old, new) for old, new in zip(before, actor.parameters(), strict=True))


def test_an_epoch_hands_out_every_sample_once_in_another_order_and_leaves_out_the_rest():
    actor, critic, _ = small_batch()
    algorithm = build(actor, critic, 10, "algo.minibatch_size=4")
    algorithm.buffer.extend(TensorDict({"number": torch.arange(10)}, [10]))
    epochs = [[minibatch["number"].tolist() for minibatch in algorithm._minibatches()] for _ in range(5)]
    assert all([len(minibatch) for minibatch in epoch] == [4, 4] for epoch in epochs)
    assert all(len({number for minibatch in epoch for number in minibatch}) == 8 for epoch in epochs)
    assert len({str(epoch) for epoch in epochs}) == 5


def test_state_continues_bit_for_bit():
    actor, critic, batch = small_batch()
    algorithm = build(actor, critic, 32, "algo.minibatch_size=8")
    algorithm.update(batch.clone())
    state, random = algorithm.state(), torch.get_rng_state()
    state = torch.load(_saved(state), weights_only=True)
    expected = algorithm.update(batch.clone())
    other_actor, other_critic, _ = small_batch()
    other = build(other_actor, other_critic, 32, "algo.minibatch_size=8")
    other.set_state(state)
    torch.set_rng_state(random)
    assert other.update(batch.clone()) == expected


def _saved(state):
    import io

    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return buffer


def test_a_minibatch_larger_than_the_batch_is_refused():
    actor, critic, _ = small_batch()
    node = composed("collector.frames_per_batch=4096", "algo.minibatch_size=5000")
    with pytest.raises(UserError, match="minibatch of 5000 is larger"):
        assemble(node.algo, actor, critic, 4096)


def test_any_torchrl_part_can_be_swapped_from_the_command_line():
    actor, critic, batch = small_batch()
    overrides = [
        "algo.loss._target_=torchrl.objectives.A2CLoss",
        "~algo.loss.clip_epsilon",
        "~algo.loss.normalize_advantage",
        "algo.optimizer._target_=torch.optim.AdamW",
        "algo.advantage._target_=torchrl.objectives.value.TDLambdaEstimator",
        "algo.scheduler=null",
    ]
    algorithm = build(actor, critic, 32, *overrides)
    assert isinstance(algorithm, OnPolicy)
    assert type(algorithm.optimizer) is torch.optim.AdamW
    assert math.isfinite(algorithm.update(batch)["loss_objective"])
