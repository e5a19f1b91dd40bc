import numpy as np
import pytest

from physai.signals import Quantity, Signal

JOINTS = ("shoulder", "elbow")


def test_bounds_have_the_shape_of_the_signal():
    signal = Signal("pose", Quantity.VIEW, (2, 3), low=(0, 1, 2, 3, 4, 5), high=(9,) * 6)
    assert signal.size == 6
    low, high = signal.bounds
    np.testing.assert_array_equal(low, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(high, np.full((2, 3), 9))


def test_a_signal_without_bounds_is_unbounded():
    low, high = Signal("memory", Quantity.MEMORY, (3,)).bounds
    assert low.tolist() == [-np.inf] * 3
    assert high.tolist() == [np.inf] * 3


def test_a_signal_may_be_bounded_on_one_side_only():
    low, high = Signal("distance", Quantity.POSITION, (1,), low=(0.0,)).bounds
    assert (low.item(), high.item()) == (0.0, np.inf)


def test_bounds_are_the_caller_s_own():
    signal = Signal("distance", Quantity.POSITION, (1,), low=(0.0,))
    signal.bounds[0][:] = 5.0
    assert signal.bounds[0].item() == 0.0


@pytest.mark.parametrize("what", ["low", "high", "labels"])
def test_a_value_for_each_number_is_needed(what):
    values = JOINTS if what == "labels" else (0.0, 0.0)
    Signal("goal", Quantity.POSITION, (2,), **{what: values})
    for wrong in (values[:1], values + values[:1]):
        with pytest.raises(ValueError, match=rf"signal 'goal': {what} has {len(wrong)} values for 2 numbers"):
            Signal("goal", Quantity.POSITION, (2,), **{what: wrong})


def test_one_number_a_joint():
    low, high = np.array([-1.0, -np.inf]), np.array([2.0, np.inf])
    signal = Signal.of_joints("joint_position", Quantity.JOINT_POSITION, JOINTS, low, high)
    assert signal.shape == (2,)
    assert signal.labels == JOINTS
    np.testing.assert_array_equal(signal.bounds, [low, high])
    assert all(type(value) is float for value in signal.low + signal.high)  # JSON knows no number of NumPy's


def test_bounds_of_another_length_than_the_joints_are_refused():
    with pytest.raises(ValueError, match="low has 1 values for 2 numbers"):
        Signal.of_joints("joint_position", Quantity.JOINT_POSITION, JOINTS, np.zeros(1), np.ones(2))


def test_units_follow_from_the_quantity():
    units = {quantity.value: Signal("x", quantity, (1,)).unit for quantity in Quantity}
    of_joints = {"joint_position": "rad", "joint_velocity": "rad/s", "angular_velocity": "rad/s"}
    none = dict.fromkeys(("pose", "direction", "twist", "action", "memory", "view"), "")
    assert units == {**of_joints, "position": "m", "time": "s", **none}
