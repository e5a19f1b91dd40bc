from pathlib import Path

import pytest
import torch

from physai.collectors import make_collector
from physai.transforms import RunningStatistics
from tests.collectors import parts


def collector(frames=256, total=1024, seed=0):
    config, env = parts.config("single", 16, frames), parts.robots(16, seed)
    return make_collector(config, env, parts.robots, parts.actor(), total, seed, 0, parts.CPU)


def test_one_set_of_statistics_holds_for_a_whole_batch():
    source = collector()
    normalization = RunningStatistics(source.env.normalizer, 0.01)
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
    parts.assert_equal(expected, got)


def resident_megabytes():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 2**20


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_memory_stays_flat_while_frames_go_by():
    source = collector(frames=1600, total=96_000)
    sizes = []
    for batch in source:
        RunningStatistics(source.env.normalizer, 0.01).update(batch["observation"])
        sizes.append(resident_megabytes())
    source.shutdown()
    assert max(sizes[40:]) - sizes[25] < 5  # 1 kB kept per 10 frames would show
