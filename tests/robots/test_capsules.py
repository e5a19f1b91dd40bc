"""A capsule that is fitted holds all it should, and not much more."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physai.robots.capsules import Piece, cut_one, smallest_capsule

NUMBER = st.floats(-0.5, 0.5).map(lambda value: round(value, 3))
POINTS = st.lists(st.tuples(NUMBER, NUMBER, NUMBER), min_size=1, max_size=12).map(np.array)


@settings(max_examples=20)
@given(POINTS)
def test_a_capsule_holds_all_points(points):
    assert smallest_capsule(points).outside(points).max() <= 1e-7


def test_of_points_on_a_capsule_that_capsule_is_found():
    generator = np.random.default_rng(0)
    way = generator.normal(size=(300, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    points = (0.05 * way + np.where(way[:, 2:] > 0, 0.2, -0.2) * [0, 0, 1]) @ turn + [0.1, 0.2, 0.3]
    found = smallest_capsule(points)
    assert found.radius == pytest.approx(0.05, rel=0.02)
    assert np.linalg.norm(found.end - found.start) == pytest.approx(0.4, rel=0.02)


def bent() -> list[np.ndarray]:
    """Two bars of 0.4 m at a right angle."""
    bar = np.array([[x, y, z] for x in (0.0, 0.4) for y in (-0.03, 0.03) for z in (-0.03, 0.03)])
    return [bar, bar[:, [1, 0, 2]]]


def inside(parts: list[np.ndarray]) -> np.ndarray:
    """Points all over convex parts: corners, and what lies between them."""
    weights = np.random.default_rng(1).dirichlet(np.full(8, 0.3), 500)
    return np.concatenate([*parts, *(weights @ part for part in parts)])


@pytest.mark.slow
def test_a_bent_link_that_is_cut_at_the_bend_needs_less_space_and_is_held_all_the_same():
    parts = bent()
    whole = Piece.of(parts)
    two = cut_one(whole, [whole])
    assert sum(piece.fitted.volume for piece in two) < 0.3 * whole.fitted.volume
    three = cut_one(whole, two)
    for pieces in ([whole], two, three, *whole.slices(3)):
        outside = np.min([piece.fitted.outside(inside(parts)) for piece in pieces], axis=0)
        assert outside.max() <= 1e-7
