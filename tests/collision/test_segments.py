"""Distances of segments and boxes are what trying many points of them finds."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from physai.collision.segments import between_segments, from_boxes

COORDINATE = st.floats(-1.0, 1.0).map(lambda value: round(value, 3))
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)


def halved(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre and direction [3, 1, 1] and half length [1, 1] of a segment."""
    half = 0.5 * np.linalg.norm(end - start)
    direction = 0.5 * (end - start) / half if half else np.array([0.0, 0.0, 1.0])
    return 0.5 * (start + end)[:, None, None], direction[:, None, None], np.full((1, 1), half)


def along(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Points of a segment."""
    share = np.linspace(0, 1, 201)[:, None]
    return start + share * (end - start)


@given(POINT, POINT, POINT, POINT)
@example((0, 0, 0), (1, 0, 0), (0, 0.5, 0), (1, 0.5, 0))  # parallel
@example((0, 0, 0), (0.3, 0, 0), (0.6, 0, 0), (0.9, 0, 0))  # on one line
@example((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0))  # crossing
@example((0, 0, 0), (0, 0, 0), (1, 0, 0), (1, 0, 0))  # points
@example((0, 0, 0), (1, 0, 0), (0.5, 0.2, 0), (0.5, 0.2, 0))  # a point beside a segment
def test_two_segments_are_as_far_apart_as_their_nearest_points(a, b, c, d):
    a, b, c, d = map(np.array, (a, b, c, d))
    first, second = halved(a, b), halved(c, d)
    found = between_segments(first[0] - second[0], first[1], second[1], first[2], second[2])
    tried = np.linalg.norm(along(a, b)[:, None] - along(c, d), axis=-1).min()
    coarse = 0.5 * (np.linalg.norm(b - a) + np.linalg.norm(d - c)) / 200
    assert tried - coarse - 1e-6 <= found.item() <= tried + 1e-6


@given(POINT, POINT, st.tuples(*[st.floats(0.05, 0.8)] * 3))
@example((-1, 0, 0.3), (1, 0, 0.3), (0.2, 0.2, 0.2))  # over a face
@example((-1, 0, 0), (1, 0, 0), (0.2, 0.2, 0.2))  # through
@example((-1, 0.9, 0.9), (1, 0.9, 0.9), (0.2, 0.2, 0.2))  # along an edge
@example((0.1, 0, 0), (0.1, 0, 0), (0.2, 0.2, 0.2))  # a point in it
def test_a_segment_is_as_far_from_a_box_as_its_nearest_point(a, b, half_size):
    a, b, half_size = map(np.array, (a, b, half_size))
    center, direction, half = halved(a, b)
    found = from_boxes(center, direction, half, half_size[:, None, None])
    tried = np.linalg.norm(np.maximum(np.abs(along(a, b)) - half_size, 0.0), axis=-1).min()
    assert tried - 0.5 * np.linalg.norm(b - a) / 200 - 1e-6 <= found.item() <= tried + 1e-6


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-5, 1e-3])
def test_segments_that_are_nearly_parallel_lose_no_digits_that_matter(angle):
    start, way = np.array([0.1, 0.2, 0.05]), np.array([np.cos(angle), np.sin(angle), 0.0])
    first = halved(np.array([-0.5, 0.0, 0.0]), np.array([0.5, 0.0, 0.0]))
    second = halved(start - 0.4 * way, start + 0.4 * way)
    found = between_segments(first[0] - second[0], first[1], second[1], first[2], second[2]).item()
    assert found == pytest.approx(np.hypot(0.2 - 0.4 * np.sin(angle), 0.05), abs=1e-7)
