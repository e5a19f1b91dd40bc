"""The lean loss against the one that it stands for."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss

from physai.algorithms import FusedClipPPOLoss
from physai.policies import Critic, GaussianActor
from tests.algorithms.assemble import assemble
from tests.composed import composed

SETTINGS = {"clip_epsilon": 0.1, "entropy_coeff": 0.03, "critic_coeff": 0.7}


@pytest.fixture
def parts():
    """An actor, a critic, and frames that the actor of some updates ago collected."""
    torch.manual_seed(0)
    actor = GaussianActor(3, 2, ["x"], [8], "torch.nn.Tanh", initial_std=0.7)
    critic = Critic(3, ["x"], [8], "torch.nn.Tanh")
    frames = TensorDict({"x": torch.randn(64, 3)}, [64])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        actor(frames)
        for parameter in actor.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    frames["advantage"], frames["value_target"] = 3 * torch.randn(64, 1) + 1, torch.randn(64, 1)
    return actor, critic, frames


@pytest.mark.parametrize("normalize", [False, True])
def test_losses_and_gradients_are_those_of_torchrl_s_loss(parts, normalize):
    actor, critic, frames = parts
    settings = {**SETTINGS, "normalize_advantage": normalize}
    stock = ClipPPOLoss(actor, critic, functional=False, loss_critic_type="l2", **settings)
    results = []
    for loss in (FusedClipPPOLoss(actor, critic, **settings), stock):
        loss.zero_grad()
        losses = loss(frames)
        sum(losses[key] for key in ("loss_objective", "loss_critic", "loss_entropy")).backward()
        results.append((losses, [parameter.grad.clone() for parameter in loss.parameters()]))
    (ours, our_gradients), (theirs, their_gradients) = results
    assert 0.2 < ours["clip_fraction"] < 0.9
    assert ours.keys() <= theirs.keys()
    for key, value in ours.items():
        torch.testing.assert_close(value, theirs[key], rtol=1e-5, atol=1e-6)
    for our, their in zip(our_gradients, their_gradients, strict=True):
        assert our.abs().max() > 0
        torch.testing.assert_close(our, their, rtol=1e-4, atol=1e-7)


def test_torchrl_s_loss_can_be_put_in_its_place_by_config(parts):
    actor, critic, frames = parts
    swap = ["algo.loss._target_=torchrl.objectives.ClipPPOLoss", "+algo.loss.loss_critic_type=l2"]
    results = []
    for overrides in ([], swap):
        node = composed("collector.frames_per_batch=64", "algo.minibatch_size=64", *overrides)
        algorithm = assemble(node.algo, actor, critic, 64)
        results.append(algorithm.loss(frames))
    assert type(algorithm.loss) is ClipPPOLoss
    for key in ("loss_objective", "loss_critic", "loss_entropy"):
        torch.testing.assert_close(results[0][key], results[1][key], rtol=1e-5, atol=1e-6)


def test_what_the_loss_reads_is_left_as_it_is(parts):
    actor, critic, frames = parts
    before = frames.clone()
    FusedClipPPOLoss(actor, critic, normalize_advantage=True, **SETTINGS)(frames)
    assert set(frames.keys()) == set(before.keys())
    assert all(torch.equal(frames[key], value) for key, value in before.items())


def test_what_it_has_no_counterpart_for_is_refused(parts):
    actor, critic, _ = parts
    with pytest.raises(TypeError, match="clip_value"):
        FusedClipPPOLoss(actor, critic, normalize_advantage=True, clip_value=0.2, **SETTINGS)
