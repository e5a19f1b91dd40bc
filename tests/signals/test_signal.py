import numpy as np
import pytest

from physai.signals import Quantity, Signal


def test_a_signal_without_bounds_is_unbounded_in_its_shape():
    low, high = Signal("view", Quantity.VIEW, (2, 3)).bounds
    assert low.shape == high.shape == (2, 3)
    assert np.isneginf(low).all()
    assert np.isposinf(high).all()


def test_a_signal_of_joints_has_a_number_with_bounds_and_a_name_for_each():
    limits = np.array([1.0, 2.0])
    signal = Signal.of_joints("speed", Quantity.JOINT_VELOCITY, ("a", "b"), -limits, limits)
    assert (signal.size, signal.labels, signal.unit) == (2, ("a", "b"), "rad/s")
    np.testing.assert_array_equal(signal.bounds, [-limits, limits])


@pytest.mark.parametrize("part", ["low", "high", "labels"])
def test_as_many_bounds_and_labels_as_numbers_or_none(part):
    values = ("a",) if part == "labels" else (1.0,)
    with pytest.raises(ValueError, match=rf"signal 'x': {part} has 1 values for 2 numbers"):
        Signal("x", Quantity.VIEW, (2,), **{part: values})


def test_signals_with_equal_parts_are_equal():
    assert Signal("x", Quantity.VIEW, (2,)) == Signal("x", Quantity.VIEW, (2,))
    assert Signal("x", Quantity.VIEW, (2,)) != Signal("x", Quantity.VIEW, (3,))
