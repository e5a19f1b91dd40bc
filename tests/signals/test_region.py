"""Regions of goals: what is drawn lies in them, and what is moved into them lies in them and is near."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from physai.signals import Box, Ring

REGIONS = [Ring(0.3, 0.53), Ring(0.0, 1.0), Box((-1.0, 2.0, 0.0), (1.0, 2.5, 0.0))]
numbers = st.floats(-1e6, 1e6)


@pytest.mark.parametrize("region", REGIONS, ids=repr)
def test_goals_that_are_drawn_lie_in_the_region_and_follow_the_generator(region):
    first, again, other = (region.sample(500, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert all(map(region.contains, first))
    np.testing.assert_array_equal(first, again)
    assert not np.isclose(first[:, :2], other[:, :2]).all(axis=1).any()
    low, high = region.bounds
    assert (first >= low - 1e-9).all()
    assert (first <= high + 1e-9).all()


def test_goals_in_a_box_are_spread_over_all_of_it():
    goals = Box((-1.0, 2.0), (1.0, 2.5)).sample(5000, torch.Generator().manual_seed(0))
    counts, _, _ = np.histogram2d(*goals.T, bins=4, range=[(-1.0, 1.0), (2.0, 2.5)])
    assert (counts > 0.8 * 5000 / 16).all()


@given(st.tuples(numbers, numbers), st.sampled_from(REGIONS[:2]))
def test_a_goal_is_moved_onto_the_ring_along_its_own_direction(goal, ring):
    projected = ring.project(np.array(goal))
    if projected is None:
        assert math.hypot(*goal) <= 1e-6
        return
    assert ring.contains(projected)
    assert math.isclose(math.atan2(*projected), math.atan2(*goal), abs_tol=1e-9)
    assert not ring.contains(np.array(goal)) or np.allclose(projected, goal, atol=1.1e-6)


@given(st.tuples(numbers, numbers, numbers))
def test_a_goal_is_moved_into_a_box_to_its_nearest_point(goal):
    box = REGIONS[2]
    projected = box.project(np.array(goal))
    assert box.contains(projected)
    np.testing.assert_array_equal(projected, np.clip(goal, box.low, box.high))


def test_a_goal_outside_is_described_by_what_is_wrong_with_it():
    assert Ring(0.3, 0.5).describe(np.array([0.6, 0.8])) == "1.000 m from the base, not 0.3 to 0.5 m"
    assert Box((0.0, 0.0), (1.0, 1.0)).describe(np.array([0.5, -3.0])) == "its number 2 is -3.000, not 0 to 1"


@pytest.mark.parametrize("radii", [(0.5, 0.3), (-0.1, 0.3), (0.1, math.inf), (math.nan, 1.0)])
def test_a_ring_that_cannot_be_is_refused(radii):
    with pytest.raises(ValueError, match="a ring needs"):
        Ring(*radii)


@pytest.mark.parametrize("bounds", [((1.0,), (0.0,)), ((0.0,), (math.inf,)), ((math.nan,), (1.0,)), ((0.0,), ())])
def test_a_box_that_cannot_be_is_refused(bounds):
    with pytest.raises(ValueError):  # noqa: PT011  (of two kinds)
        Box(*bounds)
