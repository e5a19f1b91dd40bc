from pathlib import Path

import pytest
import torch

from physai.collectors import CollectorConfig, make_collector
from physai.envs.make import make
from physai.policies import GaussianActor


def robots(num_envs, seed):
    return make("reacher", num_envs, seed)


def collector(frames=256, total=1024, seed=0):
    torch.manual_seed(0)
    actor = GaussianActor(8, 2, ["normalized_observation"], [16], "torch.nn.Tanh", 1.0)
    config = CollectorConfig(num_envs=16, frames_per_batch=frames, processes=1)
    return make_collector(config, robots(16, seed), robots, actor, total, seed)


def test_one_set_of_statistics_holds_for_a_whole_batch():
    source = collector()
    normalization = source.env.normalization
    for batch in source:
        expected = normalization.normalizer(batch["observation"])
        assert torch.equal(batch["normalized_observation"], expected)
        normalization.update(batch["observation"])
    source.shutdown()


def test_total_frames_are_rounded_up_to_whole_batches():
    source = collector(frames=256, total=300)
    assert [batch.numel() for batch in source] == [256, 256]
    source.shutdown()


def test_state_continues_bit_for_bit_in_a_new_collector():
    source = collector(seed=3)
    batches = iter(source)
    next(batches)
    state, random = source.state(), torch.get_rng_state()
    expected = next(batches).clone()
    source.shutdown()
    other = collector(seed=99)
    other.set_state(state)
    torch.set_rng_state(random)
    got = next(iter(other))
    other.shutdown()
    for key in expected.keys(True, True):
        assert torch.equal(expected[key], got[key]), key


def resident_megabytes():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 2**20


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_memory_stays_flat_while_frames_go_by():
    source = collector(frames=1600, total=240_000)
    sizes = []
    for batch in source:
        source.env.normalization.update(batch["observation"])
        sizes.append(resident_megabytes())
    source.shutdown()
    assert max(sizes[75:]) - sizes[50] < 5  # 1 kB kept per 15 frames would show
