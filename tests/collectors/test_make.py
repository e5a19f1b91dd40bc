import pytest

from physai.collectors import CollectorConfig, make_collector
from physai.errors import UserError


@pytest.mark.parametrize(
    ("num_envs", "frames", "processes", "words"),
    [
        (16, 100, 1, ["collector.frames_per_batch (100)", "multiple of", "collector.num_envs (16)"]),
        (15, 150, 2, ["collector.num_envs (15)", "multiple of", "collector.processes (2)"]),
    ],
)
def test_robots_and_steps_must_be_shared_out_evenly(num_envs, frames, processes, words):
    config = CollectorConfig(num_envs=num_envs, frames_per_batch=frames, processes=processes)
    with pytest.raises(UserError) as caught:
        make_collector(config, None, None, None, 1000, 0)
    for word in words:
        assert word in str(caught.value)
