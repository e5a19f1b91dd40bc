"""Training a policy that remembers: its own ratio is one, and it goes on from any moment bit for bit."""

import shutil

import pytest
import torch

from physai.training.agent import Agent
from tests.training.small import (
    SMALL,
    assert_same_run,
    forget_after,
    resume_here,
    run_here,
    small_config,
    train_here,
)

RECURRENT = ("policy=gru", *SMALL, "collector.num_envs=64")  # sequences of 16 steps


def test_collected_sequences_have_the_probabilities_that_learning_starts_from():
    agent = Agent.build(small_config("policy=gru", "env.task.max_steps=23", "randomization=strong"))
    batches = iter(agent.collector)
    next(batches)
    batch = next(batches)
    agent.close()
    begins = batch["episode_length"][..., 0] == 0
    assert begins[:, 1:].sum() > 32  # in the middle of sequences
    assert batch["memory"][:, 0].abs().max() > 0.1  # what was remembered of the batch before
    with torch.no_grad():
        log_prob = agent.actor.get_dist(batch).log_prob(batch["latent_action"])
    torch.testing.assert_close(log_prob, batch["action_log_prob"], rtol=0, atol=1e-5)


def test_it_learns_from_whole_sequences_each_once_an_epoch(monkeypatch):
    agent = Agent.build(small_config("policy=gru", "algo.epochs=2", "algo.minibatch_size=300"))
    seen, loss = [], agent.algorithm.loss
    forward = loss.forward
    monkeypatch.setattr(
        loss, "forward", lambda minibatch: seen.append(minibatch["latent_action"]) or forward(minibatch)
    )
    batch = next(iter(agent.collector))
    agent.algorithm.update(batch)
    agent.close()
    assert [tuple(minibatch.shape) for minibatch in seen] == [(4, 64, 2)] * 8  # 300 samples are four sequences and some
    epochs = [torch.cat(seen[:4]), torch.cat(seen[4:])]
    for epoch in epochs:
        rows = [int((batch["latent_action"] == sequence).flatten(1).all(1).nonzero()) for sequence in epoch]
        assert sorted(rows) == list(range(16))
    assert not torch.equal(*epochs)


@pytest.mark.slow
def test_one_seed_gives_one_run(tmp_path):
    hashes = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        agent = train_here(small_config(*RECURRENT, "total_frames=4096"), tmp_path / name)
        hashes.append(agent.weights_sha256())
    assert hashes[0] == hashes[1]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run = tmp_path_factory.mktemp("recurrent") / "run"
    run_here(run, *RECURRENT)
    return run


@pytest.mark.slow
@pytest.mark.parametrize("frames", [4096, 6144])  # in the middle of what the robots remember
def test_it_goes_on_from_any_checkpoint_bit_for_bit(finished, tmp_path, frames):
    shutil.copytree(finished, tmp_path / "run")
    forget_after(tmp_path / "run", frames)
    resume_here(tmp_path / "run")
    assert_same_run(tmp_path / "run", finished)
