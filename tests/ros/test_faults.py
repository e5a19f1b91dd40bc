"""Joint states spoilt on purpose, without ROS."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from physai.deploy import JointState
from physai.errors import UserError
from physai.ros.virtual.faults import FaultConfig, Faults

NAMES = ["a", "b", "c"]


def state(stamp: float) -> JointState:
    return JointState(NAMES, [1.0, 2.0, 3.0], [0.1, 0.2, 0.3], stamp)


def sent(faults: Faults, count: int = 200, start: int = 0) -> list[JointState]:
    return [found for i in range(start, start + count) for found in faults.apply(state(i), i * 0.01)]


def test_without_faults_every_state_goes_out_at_once_as_it_is():
    faults = Faults(FaultConfig(), 0)
    for i in range(10):
        assert faults.apply(state(i), i * 0.01) == [state(i)]


def test_noise_is_on_positions_alone_and_as_large_as_asked():
    found = sent(Faults(FaultConfig(fault_noise=0.1), 0), 500)
    errors = [p - q for s in found for p, q in zip(s.position, state(0).position, strict=True)]
    assert math.sqrt(sum(e * e for e in errors) / len(errors)) == pytest.approx(0.1, rel=0.1)
    assert all(s.velocity == state(0).velocity for s in found)


@pytest.mark.parametrize("probability", [0.0, 0.3, 1.0])
def test_nan_comes_as_often_as_asked_one_at_a_time(probability):
    nans = [sum(map(math.isnan, s.position)) for s in sent(Faults(FaultConfig(fault_nan=probability), 0), 1000)]
    assert set(nans) <= {0, 1}
    assert sum(nans) / 1000 == pytest.approx(probability, abs=0.05)


@pytest.mark.parametrize("probability", [0.0, 0.3, 1.0])
def test_messages_are_lost_as_often_as_asked(probability):
    assert len(sent(Faults(FaultConfig(fault_drop=probability), 0), 1000)) / 1000 == pytest.approx(
        1 - probability, abs=0.05
    )


def test_reordered_names_keep_their_values():
    found = sent(Faults(FaultConfig(fault_reorder=True), 0))
    expected = dict(zip(NAMES, zip([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], strict=True), strict=True))
    for s in found:
        assert dict(zip(s.names, zip(s.position, s.velocity, strict=True), strict=True)) == expected
    assert len({tuple(s.names) for s in found}) == 6  # all orders


def test_efforts_are_reordered_with_their_names():
    faults = Faults(FaultConfig(fault_reorder=True), 0)
    for i in range(20):
        (found,) = faults.apply(replace(state(i), effort=[7.0, 8.0, 9.0]), i * 0.01)
        assert dict(zip(found.names, found.effort, strict=True)) == {"a": 7.0, "b": 8.0, "c": 9.0}


def test_velocities_can_be_left_out():
    assert sent(Faults(FaultConfig(fault_empty_velocity=True), 0), 1) == [replace(state(0), velocity=[])]


def test_delayed_messages_come_later_in_order_with_their_old_stamps():
    faults = Faults(FaultConfig(fault_delay=0.05), 0)
    out = [[s.stamp for s in faults.apply(state(i), i * 0.01)] for i in range(20)]
    assert out[:5] == [[]] * 5
    stamps = [stamp for due in out for stamp in due]
    assert stamps == sorted(stamps)
    assert 14 <= len(stamps) <= 15  # but for rounding


def test_a_stopped_robot_is_silent_and_says_nothing_old_afterwards():
    faults = Faults(FaultConfig(), 0)
    sent(faults, 5)
    faults.config = FaultConfig(fault_stop=True)
    assert sent(faults, 100, 5) == []
    faults.config = FaultConfig()
    assert [s.stamp for s in sent(faults, 3, 105)] == [105, 106, 107]


@given(
    st.builds(
        FaultConfig,
        fault_noise=st.floats(0.0, 10.0),
        fault_nan=st.floats(0.0, 1.0),
        fault_delay=st.floats(0.0, 0.2),
        fault_drop=st.floats(0.0, 1.0),
        fault_reorder=st.booleans(),
        fault_empty_velocity=st.booleans(),
        fault_stop=st.booleans(),
    ),
    st.integers(0, 2**31 - 1),
)
def test_any_faults_together_give_well_formed_states_in_order_and_the_same_for_a_seed(config, seed):
    found = sent(Faults(config, seed), 50)
    assert repr(found) == repr(sent(Faults(config, seed), 50))
    stamps = [s.stamp for s in found]
    assert stamps == sorted(set(stamps))
    for s in found:
        assert sorted(s.names) == NAMES
        assert len(s.position) == 3
        assert len(s.velocity) == (0 if config.fault_empty_velocity else 3)


@pytest.mark.parametrize("values", [{"fault_nan": 1.1}, {"fault_delay": -0.1}, {"fault_noise": math.nan}])
def test_faults_out_of_range_are_refused(values):
    with pytest.raises(UserError, match=next(iter(values))):
        FaultConfig(**values)
