"""Targets against numbers worked out by hand, what is remembered and drawn, and going on from a saved state."""

import itertools
import math

import pytest
import torch
from tensordict import TensorDict

from physai.algorithms import NonFiniteError
from physai.errors import UserError
from physai.policies import Critic, DeterministicActor, TanhGaussianActor
from physai.training import checkpoint
from physai.training.agent import Agent
from physai.transforms.normalization import Normalizer
from tests.algorithms.assemble import assemble
from tests.composed import composed
from tests.training.small import small_config

ALGORITHMS = ("sac", "td3", "ddpg")
FRAMES = 32  # of a batch
SMALL = (
    "algo.minibatch_size=16",
    "algo.frames_per_update=8",
    "algo.warmup_frames=32",
    "algo.buffer.storage.max_size=96",
)
PRIORITIZED = (
    "algo.buffer.sampler._target_=physai.algorithms.ProportionalSampler",
    "+algo.buffer.sampler={alpha:0.7,beta:0.5}",
)
ON_DISK = ("algo.buffer.storage._target_=torchrl.data.LazyMemmapStorage",)


def build(name, *overrides, actor=None, critic=None, normalizer=None, seed=0):
    """A small algorithm: four gradient steps for each batch of 32 frames, after one batch of warm-up."""
    torch.manual_seed(seed)
    seen = ["normalized_observation"]
    if actor is None and name == "sac":
        actor = TanhGaussianActor(2, 1, seen, [8], "torch.nn.ReLU")
    actor = actor or DeterministicActor(2, 1, seen, [8], "torch.nn.ReLU", 0.2)
    critic = critic or Critic(3, [*seen, "action"], [8], "torch.nn.ReLU")
    return assemble(
        composed(f"algo={name}", *SMALL, *overrides).algo, actor, critic, FRAMES, normalizer or Normalizer(2, 10.0)
    )


def batch(seed, reward=None):
    """Frames [4, 8] as a collector brings them."""
    numbers = torch.Generator().manual_seed(seed)
    terminated = torch.rand(4, 8, 1, generator=numbers) < 0.1
    truncated = torch.rand(4, 8, 1, generator=numbers) < 0.1
    after = {
        "observation": torch.randn(4, 8, 2, generator=numbers) + 3,
        "reward": torch.randn(4, 8, 1, generator=numbers) if reward is None else reward,
        "terminated": terminated,
        "truncated": truncated,
        "done": terminated | truncated,
    }
    now = {
        "observation": torch.randn(4, 8, 2, generator=numbers) + 3,
        "action": torch.rand(4, 8, 1, generator=numbers) * 2 - 1,
    }
    frames = TensorDict({**now, "next": TensorDict(after, [4, 8])}, [4, 8])
    for each in (frames, frames["next"]):  # with statistics that are long out of date when the frame is drawn
        each["normalized_observation"] = each["observation"] * 100
    return frames


def snapshot(algorithm):
    return {name: value.clone() for name, value in algorithm.weights().items()}


def moved(before, after, part):
    """Whether the weights of a part have changed: all of them or none."""
    changed = {not torch.equal(before[name], after[name]) for name in before if name.startswith(part)}
    assert len(changed) == 1
    return changed.pop()


def minibatches(algorithm):
    """What the loss is shown from now on."""
    seen = []
    algorithm.loss.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0].clone()))
    return seen


# One-layer networks on one number: actor tanh(0.5 s); critics a line in s and the action.
GAMMA = 0.9
STATE, ACTION, NEXT_STATE, REWARD = (1.0, -2.0, 0.5), (0.2, -0.4, 0.6), (2.0, 1.5, -1.0), (1.0, 2.0, 3.0)


def three_frames():
    """One that runs on, one that terminates and one that is truncated."""

    def column(*values):
        return torch.tensor(values)[:, None]

    terminated, truncated = column(False, True, False), column(False, False, True)
    after = {"normalized_observation": column(*NEXT_STATE), "reward": column(*REWARD)}
    after |= {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    now = {"normalized_observation": column(*STATE), "action": column(*ACTION)}
    return TensorDict({**now, "next": TensorDict(after, [3])}, [3])


def one_layer(name, *overrides):
    actor = DeterministicActor(1, 1, ["normalized_observation"], [], "torch.nn.ReLU", 0.2)
    critic = Critic(2, ["normalized_observation", "action"], [], "torch.nn.ReLU")
    algorithm = build(name, f"algo.gamma={GAMMA}", *overrides, actor=actor, critic=critic)
    for key, value in algorithm.weights().items():
        if key.removeprefix("target_").startswith("actor_network_params"):
            value.fill_(0.5 if key.endswith("weight") else 0.0)
    return algorithm, algorithm.weights()


def targets(*values):
    """r + gamma * value, but for the second frame: nothing comes after a termination."""
    return [REWARD[0] + GAMMA * values[0], REWARD[1], REWARD[2] + GAMMA * values[2]]


def test_ddpg_bootstraps_on_truncation_and_not_on_termination():
    algorithm, weights = one_layer("ddpg")
    weights["value_network_params.network.0.weight"].copy_(torch.tensor([[1.0, 2.0]]))
    weights["value_network_params.network.0.bias"].fill_(0.1)
    weights["target_value_network_params.network.0.weight"].copy_(torch.tensor([[3.0, -1.0]]))
    weights["target_value_network_params.network.0.bias"].fill_(0.5)
    values = [s + 2 * a + 0.1 for s, a in zip(STATE, ACTION, strict=True)]
    wanted = targets(*(3 * s - math.tanh(0.5 * s) + 0.5 for s in NEXT_STATE))
    losses = algorithm.loss(three_frames())
    expected = sum((value - target) ** 2 for value, target in zip(values, wanted, strict=True)) / 3
    assert losses["loss_value"].item() == pytest.approx(expected, rel=1e-5)
    expected = -sum(s + 2 * math.tanh(0.5 * s) + 0.1 for s in STATE) / 3
    assert losses["loss_actor"].item() == pytest.approx(expected, rel=1e-5)


def test_td3_takes_the_smaller_of_two_targets_and_bootstraps_on_truncation_and_not_on_termination():
    algorithm, weights = one_layer("td3", "algo.loss.policy_noise=0")
    weights["qvalue_network_params.network.0.weight"].copy_(torch.tensor([[[1.0, 2.0]], [[-1.0, 1.0]]]))
    weights["qvalue_network_params.network.0.bias"].copy_(torch.tensor([[0.1], [0.2]]))
    weights["target_qvalue_network_params.network.0.weight"].copy_(torch.tensor([[[3.0, -1.0]], [[1.0, 0.5]]]))
    weights["target_qvalue_network_params.network.0.bias"].copy_(torch.tensor([[0.5], [-0.5]]))
    smaller = []
    for s in NEXT_STATE:
        a = math.tanh(0.5 * s)
        smaller.append(min(3 * s - a + 0.5, s + 0.5 * a - 0.5))  # the second of them at first, the first at last
    expected = 0.0
    for s, a, target in zip(STATE, ACTION, targets(*smaller), strict=True):
        expected += ((s + 2 * a + 0.1 - target) ** 2 + (-s + a + 0.2 - target) ** 2) / 3
    assert algorithm.loss(three_frames())["loss_qvalue"].item() == pytest.approx(expected, rel=1e-5)


def test_frames_are_remembered_raw_and_normalized_with_the_statistics_of_the_moment_they_are_drawn():
    normalizer = Normalizer(2, 10.0)
    algorithm = build("sac", normalizer=normalizer)
    first, second = batch(1), batch(2)
    algorithm.update(first.clone())
    held = algorithm.buffer.storage.get(range(FRAMES))
    assert torch.equal(held["observation"], first["observation"].reshape(-1, 2))
    assert torch.equal(held["next", "observation"], first["next", "observation"].reshape(-1, 2))
    seen = minibatches(algorithm)
    normalizer.loc.copy_(torch.tensor([3.0, 2.0]))
    normalizer.scale.copy_(torch.tensor([0.5, 2.0]))
    algorithm.update(second.clone())
    drawn = torch.cat(seen)
    raw = torch.cat([first.reshape(-1), second.reshape(-1)])[drawn["index"]]
    assert drawn["index"].min() < FRAMES <= drawn["index"].max()  # of both batches
    for now, was in ((drawn, raw), (drawn["next"], raw["next"])):
        expected = (was["observation"] - normalizer.loc) / normalizer.scale
        torch.testing.assert_close(now["normalized_observation"], expected)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_no_weight_moves_before_the_warm_up_is_over_and_the_metrics_are_the_same_all_along(name):
    algorithm = build(name, "algo.warmup_frames=64")
    weights, metrics = [snapshot(algorithm)], []
    for seed in range(3):
        metrics.append(algorithm.update(batch(seed)))
        weights.append(snapshot(algorithm))
    assert all(torch.equal(weights[0][key], weights[2][key]) for key in weights[0])
    assert moved(weights[2], weights[3], "actor_network")
    assert [list(each) for each in metrics] == [list(metrics[0])] * 3
    assert {"loss_actor", "grad_norm", "lr"} <= set(metrics[0])
    assert metrics[1]["grad_norm"] == 0 < metrics[2]["grad_norm"]
    assert all(math.isfinite(value) for each in metrics for value in each.values())


@pytest.mark.parametrize("frames_per_update", [8, 32])  # four gradient steps a batch, and one
def test_the_actor_learns_in_every_second_gradient_step_and_the_critics_in_each(frames_per_update):
    algorithm = build("td3", f"algo.frames_per_update={frames_per_update}", "algo.actor_every=2")
    algorithm.update(batch(0))
    weights = []
    algorithm.loss.register_forward_pre_hook(lambda *_: weights.append(snapshot(algorithm)))
    for seed in range(1, 5):
        algorithm.update(batch(seed))
    weights.append(snapshot(algorithm))
    steps = list(itertools.pairwise(weights))
    assert [moved(*step, "qvalue_network") for step in steps] == [True] * len(steps)
    assert [moved(*step, "actor_network") for step in steps] == [False, True] * (len(steps) // 2)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_target_networks_follow_by_tau(name):
    algorithm = build(name, "algo.target.tau=0.25", "algo.frames_per_update=32", "algo.actor_every=1")
    algorithm.update(batch(0))
    before = snapshot(algorithm)
    algorithm.update(batch(1))
    after = snapshot(algorithm)
    followers = [key for key in before if key.startswith("target_")]
    assert followers
    assert moved(before, after, "target_")
    for key in followers:
        expected = before[key] + 0.25 * (after[key.removeprefix("target_")] - before[key])
        torch.testing.assert_close(after[key], expected)


def test_target_networks_follow_in_steps_in_which_the_actor_does_not_learn_too():
    algorithm = build("td3", "algo.frames_per_update=32", "algo.actor_every=2")
    algorithm.update(batch(0))
    before = snapshot(algorithm)
    algorithm.update(batch(1))
    after = snapshot(algorithm)
    assert not moved(before, after, "actor_network")
    assert moved(before, after, "target_qvalue_network")


def test_the_temperature_falls_while_the_policy_is_more_random_than_it_has_to_be():
    algorithm = build("sac")
    metrics = [algorithm.update(batch(seed)) for seed in range(5)]
    assert metrics[0]["entropy"] > -1.0  # the target, minus the size of an action
    temperatures = [each["alpha"] for each in metrics]
    assert temperatures[0] == pytest.approx(0.2)
    assert temperatures[1:] == sorted(temperatures[1:], reverse=True)
    assert temperatures[-1] < 0.195


@pytest.mark.slow
@pytest.mark.parametrize("swap", [(), ON_DISK, PRIORITIZED], ids=["ram", "disk", "prio"])
@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("batches", [0, 2, 5])  # wrapped around after the third
def test_a_saved_state_continues_bit_for_bit(name, swap, batches, tmp_path):
    overrides = (*swap, "algo.frames_per_update=32", "algo.actor_every=2")
    algorithm = build(name, *overrides)
    for seed in range(batches):
        algorithm.update(batch(seed))
    checkpoint.save(tmp_path / "state.pt", algorithm.state())
    random = torch.get_rng_state()
    other = build(name, *overrides, seed=1)
    other.set_state(checkpoint.load(tmp_path / "state.pt"))
    results = []
    for each in (algorithm, other):
        torch.set_rng_state(random)
        metrics = [each.update(batch(seed)) for seed in range(batches, batches + 3)]
        results.append((metrics, snapshot(each)))
    (metrics, weights), (again, others) = results
    assert metrics == again
    assert weights.keys() == others.keys()
    assert all(torch.equal(weights[key], others[key]) for key in weights)


def test_a_state_holds_the_frames_that_there_are_and_no_more(tmp_path):
    algorithm = build("sac", "algo.buffer.storage.max_size=100_000")
    algorithm.update(batch(0))
    checkpoint.save(tmp_path / "state.pt", algorithm.state())
    assert all(len(values) == FRAMES for values in algorithm.state()["frames"].values())
    assert (tmp_path / "state.pt").stat().st_size < 50_000


def test_surprising_frames_are_drawn_more_often_and_count_less():
    rewards = torch.zeros(4, 8, 1)
    rewards[2, 3] = 3.0  # frame 19
    algorithm = build("ddpg", *PRIORITIZED, "algo.warmup_frames=100_000", "algo.minibatch_size=256")
    seen = minibatches(algorithm)
    for _ in range(3):
        algorithm.update(batch(0, rewards))
    assert (seen[0]["index"] == 19).sum() < 20  # of 256: nothing is known of any frame yet
    known = seen[2][seen[2]["index"] < 2 * FRAMES]  # the newest are as likely as the most surprising
    surprising = known["index"] % FRAMES == 19
    assert surprising.float().mean() > 5 / FRAMES
    weights = known["priority_weight"]
    assert weights[surprising].max() < weights[~surprising].min()
    loss, errors = algorithm.loss(known)["loss_value"], known["td_error"]
    torch.testing.assert_close(loss, (errors * weights).sum() / weights.sum())
    assert loss < errors.mean()


@pytest.mark.parametrize("name", ["td3", "ddpg"])
def test_a_priority_is_a_power_of_the_td_error_where_the_loss_reports_its_square_too(name):
    exact = ["algo.loss.policy_noise=0"] if name == "td3" else []  # the same frame may be drawn twice
    algorithm = build(name, *PRIORITIZED, *exact, "algo.warmup_frames=100_000")
    calls = []
    algorithm.loss.register_forward_hook(lambda _, arguments, losses: calls.append((arguments[0], losses)))
    algorithm.update(batch(0))
    ((frames, losses),) = calls
    error = (losses["pred_value"] - losses["target_value"]).abs().reshape(-1, len(frames)).max(dim=0)[0]
    priority = algorithm.buffer.sampler.priorities[frames["index"]].float()
    torch.testing.assert_close(priority, (error + 1e-6) ** 0.7)
    assert error.max() > 1  # the square of which is larger


def test_uniform_sampling_is_told_of_no_priorities(recwarn):
    build("sac", "algo.warmup_frames=100_000").update(batch(0))
    assert not [warning for warning in recwarn if "update_priority" in str(warning.message)]


def test_a_reward_that_is_not_a_number_stops_before_the_step_and_hands_over_the_minibatch():
    algorithm = build("sac")
    algorithm.update(batch(0))
    before = snapshot(algorithm)
    with pytest.raises(NonFiniteError, match="loss") as caught:
        algorithm.update(batch(1, reward=torch.full((4, 8, 1), float("nan"))))
    assert caught.value.batch["next", "reward"].isnan().any()
    after = snapshot(algorithm)
    assert all(torch.equal(before[key], after[key]) for key in before)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["algo=sac", "policy=mlp"], r"policy\.critic\.in_keys: .* it must see 'action'"),
        (["algo=ppo", "policy=mlp_soft"], r"policy\.critic\.in_keys: .* it must not see 'action'"),
        (["algo=sac", "policy=mlp_deterministic"], r"policy\.actor: .* distribution, and DeterministicActor has none"),
        (
            ["algo=sac", "policy=mlp", "policy.critic.in_keys=[normalized_observation,features,action]"],
            r"policy\.actor: this loss would learn from 'latent_action'",
        ),
        (["algo=sac", "policy=gru"], r"policy\.actor: .* must not remember"),
        (
            ["algo=td3", "policy.critic.in_keys=[normalized_observation,physics_parameters,action]"],
            r"policy\.critic\.in_keys: .* not 'physics_parameters'",
        ),
        (["algo=sac", "algo.frames_per_update=3"], r"algo\.frames_per_update \(3\) must divide .*\(64\)"),
        (["algo=sac", "algo.buffer.storage.max_size=63"], r"algo\.buffer\.storage\.max_size: .* into 63"),
        (["algo=sac", "+algo.buffer.batch_size=16"], r"algo\.buffer\.batch_size: leave it out"),
        (["algo=sac", "algo.buffer.storage._target_=torchrl.data.ListStorage"], r"algo\.buffer: .* got ListStorage"),
        (["algo=sac", "algo.gamma=1.5"], r"algo\.gamma: must be between 0 and 1, got 1\.5"),
        (["algo=sac", "algo.loss.alpha_init=0"], r"algo\.loss: math domain error"),
    ],
)
def test_parts_that_do_not_go_together_are_refused_in_one_line(overrides, message):
    small = ("collector.num_envs=4", "collector.frames_per_batch=64", "algo.minibatch_size=64")
    with pytest.raises(UserError, match=message) as refused:
        Agent.build(small_config(*small, *overrides))
    assert "\n" not in str(refused.value)


def test_a_privileged_critic_of_sac_judges_what_comes_after_a_frame_too():
    critic = "policy.critic.in_keys=[normalized_observation,features,physics_parameters,action]"
    small = ("collector.num_envs=4", "collector.frames_per_batch=64", "algo.warmup_frames=64")
    agent = Agent.build(small_config("algo=sac", critic, *small))
    batches = iter(agent.collector)
    metrics = [agent.algorithm.update(next(batches)) for _ in range(2)]
    agent.close()
    assert metrics[1]["grad_norm"] > 0
