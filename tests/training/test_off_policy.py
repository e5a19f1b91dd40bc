"""Training from a replay buffer: random actions first, and going on from any moment bit for bit, buffer included."""

import shutil

import pytest
import torch

from physai.training.agent import Agent
from tests.training.small import SMALL, assert_same_run, forget_after, resume_here, run_here, small_config

OFF_POLICY = (
    "algo=sac",
    *SMALL,
    "checkpoint.every_frames=1024",
    "checkpoint.keep=10",
    "algo.warmup_frames=2048",
    "algo.frames_per_update=64",
    "algo.buffer.storage.max_size=3072",  # of which the run goes round twice
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run = tmp_path_factory.mktemp("off_policy") / "run"
    run_here(run, *OFF_POLICY)
    return run


def test_the_actions_of_the_warm_up_are_random_and_later_ones_are_the_policys():
    agent = Agent.build(small_config(*OFF_POLICY))
    with torch.no_grad():  # a policy that does nothing but one thing
        agent.actor.network[-1].weight.zero_()
        agent.actor.network[-1].bias.copy_(torch.tensor([3.0, 3.0, -9.0, -9.0]))
    batches = iter(agent.collector)
    actions = [next(batches)["action"].clone() for _ in range(3)]
    agent.close()
    for warm_up in actions[:2]:
        quarters = torch.histc(warm_up, 4, -1.0, 1.0) / warm_up.numel()
        torch.testing.assert_close(quarters, torch.full((4,), 0.25), rtol=0, atol=0.05)
    assert actions[2].min() > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("frames", [1024, 2048, 5120])  # in the warm-up, right after it, and when the buffer is full
def test_it_goes_on_from_any_checkpoint_bit_for_bit(finished, tmp_path, frames):
    shutil.copytree(finished, tmp_path / "run")
    forget_after(tmp_path / "run", frames)
    resume_here(tmp_path / "run")
    assert_same_run(tmp_path / "run", finished)
