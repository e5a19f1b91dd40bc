"""Ranges that a learner moves reach the robots of every collector, and at a batch that is known beforehand."""

import pytest
import torch

from physai.collectors import make_collector
from physai.config import validate
from physai.envs.make import make_env
from physai.training.config import TrainConfig
from tests.collectors import parts
from tests.composed import composed

WIDE = validate(TrainConfig, composed("randomization=wide", "env.task.max_steps=8"))


def robots(num_envs, seed):
    return make_env(WIDE.env, WIDE.randomization, WIDE.normalization, num_envs, seed, pinned=0.5)


@pytest.mark.parametrize(
    ("kind", "late"),  # a batch that was begun before has the ranges of then: as many as processes, where none wait
    [
        ("single", 0),
        pytest.param("async", 1, marks=pytest.mark.slow),
        pytest.param("multi_sync", 0, marks=pytest.mark.slow),
        pytest.param("multi_async", 2, marks=pytest.mark.slow),
    ],
)
def test_episodes_that_begin_in_a_batch_are_drawn_from_its_ranges(kind, late):
    assert_ranges_are_followed(kind, late)


def assert_ranges_are_followed(kind, late):
    """Those of Ray are looked at where a cluster is, in test_ray.py."""
    env = robots(8 if kind == "single" else 1, 0)
    source = make_collector(parts.config(kind), env, robots, parts.actor(), 128 * 6, 0, 0, parts.CPU)
    try:
        ranges, payload = env.ranges, env.simulation.layout.columns["payload"]
        for number, batch in enumerate(source):
            begun = batch["episode_length"][..., 0] == 0
            begun[:, 0] = False  # at the end of the batch before
            drawn = batch["physics_parameters"][begun][:, payload]
            boundary = batch["boundary"][begun][:, 0]
            moves = (boundary[boundary > 0] - 1) // len(ranges.sides)
            assert len(moves) > 0
            expected = max(0, number - late)
            assert set(moves.tolist()) == {expected}
            highest = 5.0 * expected / 10
            assert drawn.max() == pytest.approx(highest, rel=0.4) if highest else not drawn.any()
            ranges.move(torch.full_like(ranges.share, (number + 1) / 10))
    finally:
        source.shutdown()
        env.close()
