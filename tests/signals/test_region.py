"""Regions: what is drawn lies inside, what lies outside has a nearest point inside."""

import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

from physai.signals import Ball, Box, Reachable, Ring
from physai.signals.region import REGIONS

RING = Ring(0.3, 0.53)
KINDS = ["ring", "ball", "box", "reachable"]
BOX = Box((-1.0, 0.0, 2.0), (1.0, 0.5, 2.0))

numbers = st.floats(-1e6, 1e6)
radii = st.floats(0, 1e3)


@st.composite
def rings(draw):
    return Ring(*sorted((draw(radii), draw(radii))))


@st.composite
def boxes(draw):
    pairs = [sorted(pair) for pair in draw(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=8))]
    return Box(*(tuple(side) for side in zip(*pairs, strict=True)))


@st.composite
def balls(draw):
    return Ball(tuple(draw(st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3))), draw(st.floats(1e-3, 1e3)))


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_points_of_a_ring_have_a_uniform_angle_and_radius():
    x, y = RING.sample(5000, generator()).T.astype(float)
    radius, angle = np.hypot(x, y), np.arctan2(y, x) % (2 * np.pi)
    assert stats.kstest(angle, stats.uniform(0, 2 * np.pi).cdf).pvalue > 1e-3
    assert stats.kstest(radius, stats.uniform(0.3, 0.23).cdf).pvalue > 1e-3
    assert abs(stats.spearmanr(angle, radius).statistic) < 0.05


def test_numbers_of_a_box_are_uniform_and_independent():
    first, second, fixed = BOX.sample(5000, generator()).T
    assert stats.kstest(first, stats.uniform(-1, 2).cdf).pvalue > 1e-3
    assert stats.kstest(second, stats.uniform(0, 0.5).cdf).pvalue > 1e-3
    assert abs(stats.spearmanr(first, second).statistic) < 0.05
    assert (fixed == 2.0).all()


@given(st.one_of(rings(), boxes(), balls()), st.integers(0, 2**32))
def test_what_is_drawn_is_inside_and_within_the_bounds(region, seed):
    goals = region.sample(20, generator(seed))
    low, high = region.bounds
    assert goals.shape == (20, len(low))
    room = 1e-6 * (1 + max(np.abs(low).max(), np.abs(high).max()))  # a ring draws in single precision
    assert (goals >= low - room).all()
    assert (goals <= high + room).all()
    for goal in goals:
        nearest = region.project(goal)
        assert nearest is None or np.abs(nearest - goal).max() <= room


@pytest.mark.parametrize("region", [RING, BOX], ids=["ring", "box"])
def test_draws_follow_the_generator(region):
    first, again, other = (region.sample(16, generator(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.isclose(first[:, :2], other[:, :2]).any()


@pytest.mark.parametrize("region", [RING, BOX], ids=["ring", "box"])
def test_all_that_is_drawn_counts_as_inside(region):
    assert all(region.contains(goal) for goal in region.sample(1000, generator()))


@pytest.mark.parametrize("angle", np.linspace(0, 2 * np.pi, 9))
def test_the_edges_of_a_ring_belong_to_it_and_a_tenth_of_a_millimetre_beyond_them_does_not(angle):
    direction = np.array([math.cos(angle), math.sin(angle)])
    for radius in (0.3, 0.53):
        assert RING.contains(radius * direction)
        assert RING.contains(np.round(radius * direction, 7))  # as a person writes it
    assert not RING.contains(0.2999 * direction)
    assert not RING.contains(0.5301 * direction)


def test_the_edges_of_a_box_belong_to_it_and_one_number_beyond_them_is_enough_to_be_outside():
    for goal in ([-1.0, 0.0, 2.0], [1.0, 0.5, 2.0]):
        assert BOX.contains(np.array(goal))
    for goal in ([-1.0001, 0.2, 2.0], [0.0, 0.5001, 2.0], [0.0, 0.2, 1.9]):
        assert not BOX.contains(np.array(goal))


@given(rings(), numbers, numbers)
def test_no_point_of_a_ring_is_nearer_than_the_projection(ring, x, y):
    goal = np.array([x, y])
    assume(np.hypot(x, y) > 1e-3)
    nearest = ring.project(goal)
    room = 1e-9 * (1 + np.abs(goal).max() + ring.outer)
    assert ring.inner - room <= np.hypot(*nearest) <= ring.outer + room
    distance = np.hypot(*(nearest - goal))
    others = ring.sample(50, generator()).astype(float)
    assert distance <= np.hypot(*(others - goal).T).min() + room + 1e-5 * ring.outer


@given(boxes(), st.lists(numbers, min_size=8, max_size=8), st.integers(0, 100))
def test_no_point_of_a_box_is_nearer_than_the_projection(box, numbers, seed):
    goal = np.array(numbers[: len(box.low)])
    nearest = box.project(goal)
    assert box.contains(nearest)
    others = box.sample(50, generator(seed))
    assert np.linalg.norm(nearest - goal) <= np.linalg.norm(others - goal, axis=1).min() * (1 + 1e-12)
    np.testing.assert_array_equal(box.project(nearest), nearest)


def test_a_goal_inside_is_its_own_nearest_point():
    np.testing.assert_allclose(RING.project(np.array([0.0, 0.4])), [0.0, 0.4], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(BOX.project(np.array([0.1, 0.2, 2.0])), [0.1, 0.2, 2.0])


@pytest.mark.parametrize("goal", [[0.0, 0.0], [1e-9, 0.0], [1.7e308, 1.7e308]])
def test_nothing_is_nearest_to_the_centre_of_a_ring_or_to_what_is_too_far_to_have_a_distance(goal):
    assert RING.project(np.array(goal)) is None


def test_a_description_says_where_a_goal_lies_and_where_it_should():
    assert RING.describe(np.array([0.6, 0.0])) == "0.600 m from the base, not 0.3 to 0.53 m"
    assert BOX.describe(np.array([0.0, 0.9, 2.2])) == "its number 2 is 0.900, not 0 to 0.5"


@pytest.mark.parametrize("radii", [(0.5, 0.3), (-0.1, 0.5), (0.1, math.inf), (math.nan, 1.0), (0.1, math.nan)])
def test_a_ring_without_room_is_refused(radii):
    with pytest.raises(ValueError, match="inner"):
        Ring(*radii)


@pytest.mark.parametrize(
    ("low", "high"),
    [((1.0,), (0.0,)), ((-math.inf,), (0.0,)), ((0.0,), (math.inf,)), ((math.nan,), (0.0,)), ((0.0, 0.0), (1.0,))],
)
def test_a_box_without_bounds_is_refused(low, high):
    with pytest.raises(ValueError, match=r"lower and upper|shorter"):
        Box(low, high)


def test_a_policy_file_names_regions_by_their_kind():
    assert [(name, region.kind) for name, region in REGIONS.items()] == [(kind, kind) for kind in KINDS]


def test_points_of_a_ball_are_uniform():
    ball = Ball((0.5, -0.2, 0.4), 0.3)
    away = ball.sample(5000, generator()) - np.array(ball.center)
    radius = np.linalg.norm(away, axis=1)
    assert stats.kstest((radius / 0.3) ** 3, "uniform").pvalue > 1e-3
    assert stats.kstest(away[:, 2] / radius, stats.uniform(-1, 2).cdf).pvalue > 1e-3
    assert np.abs(away.mean(axis=0)).max() < 0.01


@given(balls(), st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3))
def test_no_point_of_a_ball_is_nearer_than_the_projection(ball, point):
    goal, projected = np.array(point), ball.project(np.array(point))
    distance = np.linalg.norm(goal - np.array(ball.center))
    assert ball.contains(projected) or ball.radius < 1e-2
    assert np.linalg.norm(goal - projected) == pytest.approx(max(distance - ball.radius, 0.0), abs=1e-5)


@pytest.mark.parametrize(("center", "radius"), [((0.0, 0.0), 1.0), ((0.0, 0.0, math.nan), 1.0), ((0.0, 0.0, 0.0), 0.0)])
def test_a_ball_without_room_or_place_is_refused(center, radius):
    with pytest.raises(ValueError, match="a ball needs a centre"):
        Ball(center, radius)


def test_examples_are_drawn_of_what_was_reached_and_its_bounds_say_what_else_may_be():
    region = Reachable((0.0, 0.0), (1.0, 2.0), (0.1, 0.2, 0.9, 1.8))
    drawn = region.sample(50, generator())
    assert {tuple(goal) for goal in drawn} == {(0.1, 0.2), (0.9, 1.8)}
    assert region.contains(np.array([0.5, 1.0]))
    assert not region.contains(np.array([0.5, 2.1]))
    np.testing.assert_array_equal(region.project(np.array([0.5, 2.1])), [0.5, 2.0])
    assert "its number 2 is 2.100" in region.describe(np.array([0.5, 2.1]))


@pytest.mark.parametrize(
    ("examples", "line"), [((), "are no examples"), ((0.1, 0.2, 0.3), "are no examples"), ((0.1, 9.0), "not within")]
)
def test_examples_that_are_none_are_refused(examples, line):
    with pytest.raises(ValueError, match=line):
        Reachable((0.0, 0.0), (1.0, 2.0), examples)
