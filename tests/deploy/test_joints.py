import dataclasses
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from physai.deploy import ControllerConfig, JointState
from physai.deploy.joints import Heard, JointReader, JointStateError

NAMES = ("joint1", "joint2")


@pytest.fixture(scope="module")
def metadata(policy):
    return policy.metadata  # two joints, of 2.5 rad/s; the first turns without end


@pytest.fixture
def reader(metadata):
    return JointReader(metadata, ControllerConfig())


@pytest.fixture
def estimating(metadata):
    return JointReader(metadata, ControllerConfig(allow_velocity_estimate=True))


def state(position=(0.1, 0.2), velocity=(0.3, 0.4), stamp=0.0, names=NAMES):
    return JointState(names, position, velocity, stamp)


def read(reader, *arguments, received=None, **values):
    """Of a state that is received when it is stamped, unless a test says otherwise."""
    joint_state = state(*arguments, **values)
    return reader.read(joint_state, joint_state.stamp if received is None else received)


def estimated(reader, *arguments, **values):
    read(reader, *arguments, **values)
    return reader.velocity


def rejection(reader, *arguments, implausible=False, **values):
    with pytest.raises(JointStateError) as caught:
        read(reader, *arguments, **values)
    assert str(caught.value).startswith("joint state rejected: ")
    assert caught.value.implausible is implausible
    return caught.value.kind


def assert_reads(reader, joint_state, position, velocity):
    assert reader.read(joint_state, joint_state.stamp) == Heard(complete=True, another=None)
    for found, expected in ((reader.position, position), (reader.velocity, velocity)):
        assert found.dtype == np.float64
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_positions_and_velocities_are_read(reader):
    assert_reads(reader, state(), [0.1, 0.2], [0.3, 0.4])
    assert_reads(reader, state(np.array([0.1, 0.2]), np.array([0.3, 0.4]), 0.02, list(NAMES)), [0.1, 0.2], [0.3, 0.4])


def test_joints_are_mapped_by_name_and_extra_ones_ignored(reader):
    names = ("gripper", "joint2", "wheel", "joint1")
    assert_reads(reader, state((9.0, 0.2, 7.0, 0.1), (5.0, 0.4, 6.0, 0.3), 0.0, names), [0.1, 0.2], [0.3, 0.4])


def test_the_order_may_change_from_one_state_to_the_next(reader):
    assert_reads(reader, state(), [0.1, 0.2], [0.3, 0.4])
    assert_reads(reader, state((0.2, 0.1), (0.4, 0.3), 0.02, NAMES[::-1]), [0.1, 0.2], [0.3, 0.4])
    assert rejection(reader, (0.2, 0.1), (0.4, 0.3), 0.04, ("joint1", "joint1")) == "duplicate name"
    assert_reads(reader, state((0.2, 0.1), (0.4, 0.3), 0.06, NAMES[::-1]), [0.1, 0.2], [0.3, 0.4])
    assert_reads(reader, state(stamp=0.08), [0.1, 0.2], [0.3, 0.4])


def test_what_an_extra_joint_does_is_of_no_concern(reader):
    names = (*NAMES, "gripper")
    for stamp, value in enumerate((math.nan, math.inf, 1e9)):
        assert_reads(reader, state((0.1, 0.2, value), (0.3, 0.4, value), stamp, names), [0.1, 0.2], [0.3, 0.4])


@given(st.permutations((("joint1", 0.1, 0.3), ("joint2", 0.2, 0.4), ("a", 1.0, 1.0), ("b", 2.0, 2.0), ("c", 3.0, 3.0))))
def test_every_order_reads_the_same(metadata, rows):
    names, position, velocity = zip(*rows, strict=True)
    joint_reader = JointReader(metadata, ControllerConfig())
    assert_reads(joint_reader, state(position, velocity, 0.0, names), [0.1, 0.2], [0.3, 0.4])


NO_NUMBERS = (None, ("a", "b"), ("0.1", "0.2"), (None, 0.2), ((0.1,), 0.2), (10**400, 0.2), (True, False), (1j, 0.2))


@pytest.mark.parametrize(
    ("kind", "bad"),
    {
        "duplicate name": {"names": ("joint1", "joint1")},
        "duplicate name ": {"names": (*NAMES, "joint2"), "position": (0.1, 0.2, 0.3), "velocity": ()},
        "lengths disagree": {"position": (0.1,)},
        "lengths disagree ": {"position": (0.1, 0.2, 0.3)},
        "lengths disagree  ": {"position": ((0.1,), (0.2,))},
        "lengths disagree   ": {"velocity": (0.1,)},
        "lengths disagree    ": {"velocity": (0.1, 0.2, 0.3)},
        **{f"malformed position {i}": {"position": bad} for i, bad in enumerate(NO_NUMBERS)},
        **{f"malformed velocity {i}": {"velocity": bad} for i, bad in enumerate(NO_NUMBERS)},
        **{f"malformed names {i}": {"names": bad} for i, bad in enumerate((None, 7, [["joint1"], "joint2"]))},
        **{f"malformed stamp {i}": {"stamp": bad} for i, bad in enumerate((None, "now", "0.01", [0.1], 10**400))},
        "position not finite": {"position": (math.nan, 0.2)},
        "position not finite ": {"position": (0.1, math.inf)},
        "position not finite  ": {"position": (-math.inf, 0.2)},
        "stamp not finite": {"stamp": math.nan},
        "stamp not finite ": {"stamp": math.inf},
    }.items(),
)
def test_a_malformed_state_is_rejected_and_forgotten(reader, kind, bad):
    assert_reads(reader, state(), [0.1, 0.2], [0.3, 0.4])
    kind = "malformed" if kind.startswith("malformed") else kind.strip()
    assert rejection(reader, received=0.01, **{"stamp": 0.01, **bad}) == kind
    assert_reads(reader, state(stamp=0.01), [0.1, 0.2], [0.3, 0.4])  # not repeated: the stamp was not taken over


@pytest.mark.parametrize(
    "other",
    [
        {"names": ("finger1", "finger2")},
        {"names": (), "position": (), "velocity": ()},
        {"names": ("finger", "finger"), "position": (math.nan,), "velocity": ("fast",), "stamp": None},
    ],
)
def test_a_state_that_names_none_of_the_joints_is_not_ours_whatever_else_it_says(reader, other):
    read(reader)
    assert read(reader, received=0.01, **other) is None
    assert_reads(reader, state((0.11, 0.2), stamp=0.02), [0.11, 0.2], [0.3, 0.4])


def test_states_of_some_joints_are_merged_joint_by_joint(reader):
    first = state((0.1, 7.0), (0.3, 7.0), 0.0, ("joint1", "finger"))
    assert reader.read(first, 5.00) == Heard(complete=False, another=None)
    assert reader.received == -math.inf
    assert reader.oldest() == "joint2"
    assert reader.read(state((0.2,), (0.4,), 900.0, ("joint2",)), 5.01) == Heard(complete=True, another=None)
    np.testing.assert_array_equal([reader.position, reader.velocity], [[0.1, 0.2], [0.3, 0.4]])
    assert reader.received == 5.00  # as old as its oldest joint
    assert not reader.read(state((0.21,), (0.4,), 900.02, ("joint2",)), 5.03).complete
    assert not reader.read(state((0.22,), (0.4,), 900.04, ("joint2",)), 5.05).complete
    assert (reader.received, reader.oldest()) == (5.00, "joint1")
    assert reader.read(state((0.13,), (0.3,), 0.06, ("joint1",)), 5.06).complete
    np.testing.assert_allclose([reader.position, reader.velocity], [[0.13, 0.22], [0.3, 0.4]])
    assert (reader.received, reader.oldest()) == (5.05, "joint2")


def test_each_joint_is_judged_by_its_own_state_before(reader):
    for stamp in np.arange(50) * 0.02:
        read(reader, (0.1,), (0.0,), float(stamp), ("joint1",))
    read(reader, (0.2,), (0.0,), 0.0, ("joint2",))  # joint2's clock is another one
    with pytest.raises(JointStateError, match=r"'joint2' jumped by 0\.300 rad in 0\.020 s"):
        read(reader, (0.1, 0.5), (0.0, 0.0), stamp=1.0 - 0.98, received=1.0, names=("finger", "joint2"))
    with pytest.raises(JointStateError, match="its stamp is that of the state before"):
        read(reader, (0.1,), (0.0,), 0.98, ("joint1",))


def test_a_joint_that_another_source_tells_is_named(reader):
    def told(names, source, stamp):
        values = (0.1,) * len(names)
        return reader.read(JointState(names, values, values, stamp, source=source), stamp)

    assert told(("joint1",), "a", 0.02).another is None
    assert told(("joint2",), "b", 0.02).another is None
    assert told(("joint2",), "b", 0.04).another is None
    assert told(NAMES, "a", 0.06).another == "joint2"
    assert told(NAMES, None, 0.08).another is None  # nobody knows
    assert told(NAMES, "a", 0.10).another is None


def test_efforts_are_read_where_they_are_told(reader):
    assert not reader.feels
    reader.read(JointState(NAMES, (0.1, 0.2), (0.0, 0.0), 0.0, effort=(1.0, math.nan)), 0.0)
    np.testing.assert_array_equal(reader.effort, [1.0, math.nan])
    assert reader.feels
    read(reader, stamp=0.02)
    assert np.isnan(reader.effort).all()
    with pytest.raises(JointStateError, match="2 names, but effort has the shape"):
        reader.read(JointState(NAMES, (0.1, 0.2), (0.0, 0.0), 0.04, effort=(1.0,)), 0.04)


@pytest.mark.parametrize("turns", [-(10**6), -1, 0, 1, 10**6])
def test_a_joint_without_limits_is_turned_back_in_double_precision(reader, turns):
    read(reader, (0.5 + turns * 2 * math.pi, 2.5), (0.0, 0.0))
    np.testing.assert_allclose(reader.turned, [0.5, 2.5], atol=2e-9)
    if not turns:
        assert reader.turned.tolist() == [0.5, 2.5]


@pytest.mark.parametrize("velocity", [(), (math.nan, 0.4), (0.3, math.nan), (math.inf, 0.4), (math.nan, math.nan)])
def test_without_a_velocity_a_state_is_rejected(reader, velocity):
    read(reader)
    assert rejection(reader, velocity=velocity, stamp=0.02) == "velocity missing"


@pytest.mark.parametrize(
    ("velocity", "expected"),
    [
        ((), [0.5, -0.25]),
        ((math.nan, math.nan), [0.5, -0.25]),
        ((0.3, math.nan), [0.3, -0.25]),
        ((math.inf, 7), [0.5, 7]),
    ],
)
def test_where_allowed_a_missing_velocity_is_estimated_from_positions(estimating, velocity, expected):
    read(estimating)
    assert_reads(estimating, state((0.11, 0.195), velocity, 0.02), [0.11, 0.195], expected)


def test_an_estimate_follows_the_order_of_the_names(estimating):
    read(estimating)
    assert_reads(
        estimating, state((0.195, 9.0, 0.11), (), 0.02, ("joint2", "c", "joint1")), [0.11, 0.195], [0.5, -0.25]
    )


def test_an_estimate_needs_a_recent_position(estimating):
    assert rejection(estimating, velocity=()) == "velocity missing"
    assert_reads(estimating, state(velocity=(), stamp=0.1), [0.1, 0.2], [0.0, 0.0])
    assert rejection(estimating, velocity=(), stamp=0.3) == "velocity missing"
    assert_reads(estimating, state(velocity=(), stamp=0.35), [0.1, 0.2], [0.0, 0.0])


def test_the_noise_of_encoders_is_no_motion_to_refuse_however_close_two_states_are(estimating):
    read(estimating)
    assert_reads(estimating, state((0.109, 0.2), (), 0.001), [0.109, 0.2], [7.5, 0.0])  # the fastest that can be
    assert_reads(estimating, state((0.100, 0.2), (), 0.002), [0.100, 0.2], [-7.5, 0.0])


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_position_that_jumped_is_implausible(reader, joint, sign):
    read(reader)
    moved = [0.1, 0.2]
    moved[joint] += sign * (3 * 2.5 * 0.02 + 0.011)
    assert rejection(reader, moved, stamp=0.02, implausible=True) == "position jump"
    assert_reads(reader, state(moved, stamp=0.04), moved, [0.3, 0.4])  # if it stays there, the arm is there


def test_how_far_a_joint_can_move_grows_with_time_and_factor(reader, metadata):
    read(reader)
    assert_reads(reader, state((0.1, 0.2 + 7.4), stamp=1.0), [0.1, 7.6], [0.3, 0.4])
    strict = JointReader(metadata, ControllerConfig(jump_factor=1.0))
    read(strict)
    assert rejection(strict, (0.1 + 2.6, 0.2), stamp=1.0, implausible=True) == "position jump"


@pytest.mark.parametrize("sign", [1, -1])
def test_a_continuous_joint_may_be_counted_from_half_a_turn_to_half_a_turn(estimating, sign):
    read(estimating, (sign * 3.13, 0.2))
    speed = sign * (2 * math.pi - 6.26) / 0.02
    assert_reads(estimating, state((-sign * 3.13, 0.2), (), 0.02), [-sign * 3.13, 0.2], [speed, 0.0])
    assert_reads(estimating, state((sign * 3.13, 0.2), (), 0.04), [sign * 3.13, 0.2], [-speed, 0.0])


@given(st.floats(-50, 50), st.integers(-9, 9), st.floats(-math.pi, math.pi), st.sampled_from([0.02, 0.1, 0.3]))
def test_a_continuous_joint_has_moved_the_shorter_way_around(metadata, start, turns, moved, elapsed):
    joint_reader = JointReader(metadata, ControllerConfig(allow_velocity_estimate=True, state_timeout=1.0))
    read(joint_reader, (start, 0.2))
    there = (start + moved + turns * 2 * math.pi, 0.2)
    if abs(abs(moved) - 7.5 * elapsed - 0.01) < 1e-9:
        return  # on the very edge, rounding decides
    if abs(moved) > 7.5 * elapsed + 0.01:
        assert rejection(joint_reader, there, stamp=elapsed, implausible=True) == "position jump"
    else:
        velocity = estimated(joint_reader, there, (), elapsed)
        np.testing.assert_allclose(velocity, [np.clip(moved / elapsed, -7.5, 7.5), 0.0], atol=1e-9)


def test_a_jump_of_a_continuous_joint_is_told_as_the_shorter_way_around(reader):
    read(reader)
    with pytest.raises(JointStateError, match=r"'joint1' jumped by -1\.000 rad in 0\.020 s"):
        read(reader, (0.1 - 1.0 + 4 * math.pi, 0.2), stamp=0.02)


@pytest.mark.parametrize("limit", [(-2.6, 2.6), (-2.6, math.inf), (-math.inf, 2.6)])
def test_a_joint_with_a_limit_cannot_turn_around(metadata, limit):
    limited = dataclasses.replace(metadata, position_limit=np.array([(-math.inf, math.inf), limit]))
    joint_reader = JointReader(limited, ControllerConfig())
    read(joint_reader)
    assert rejection(joint_reader, (0.1, 0.2 - 2 * math.pi), stamp=0.02, implausible=True) == "position jump"


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("joint", [0, 1])
def test_a_jump_too_far_for_a_float_is_a_jump(reader, joint):
    positions = np.zeros((2, 2))
    positions[:, joint] = -1.7e308, 1.7e308
    read(reader, positions[0])
    assert rejection(reader, positions[1], stamp=0.02, implausible=True) == "position jump"


def test_configured_anew_it_keeps_the_last_state_and_judges_the_next_by_the_new_values(reader):
    read(reader)
    reader.configure(ControllerConfig(jump_factor=1.0))
    assert rejection(reader, (0.1, 0.2 + 0.07), stamp=0.02, implausible=True) == "position jump"
    assert rejection(reader, velocity=(2.6, 0.0), stamp=0.06, implausible=True) == "velocity implausible"
    reader.configure(ControllerConfig(allow_velocity_estimate=True))
    assert_reads(reader, state((0.11, 0.195), (), 0.08), [0.11, 0.195], [0.5, -0.25])
    reader.configure(ControllerConfig(allow_velocity_estimate=True, state_timeout=0.01))
    assert rejection(reader, velocity=(), stamp=0.1) == "velocity missing"


@pytest.mark.parametrize(
    ("stamp", "received", "farthest"),
    [
        (0.05, 0.0, 0.375),  # sooner than stamped, but within state_timeout: the stamps count
        (1.0, 0.02, 0.9),  # 3 * 2.5 rad/s for 0.02 s of receipt and 0.1 s of state_timeout
        (3600.0, 0.02, 0.9),
        (3600.0, -9.0, 0.75),
        (0.02, 3600.0, 0.15),
    ],
)
def test_a_stamp_that_runs_ahead_of_the_time_of_receipt_makes_no_room_for_a_jump(metadata, stamp, received, farthest):
    for moved in (farthest + 0.009, -farthest - 0.009):
        reader = JointReader(metadata, ControllerConfig())
        read(reader)
        read(reader, (0.1 + moved, 0.2), stamp=stamp, received=received)
    for moved in (farthest + 0.011, -farthest - 0.011):
        reader = JointReader(metadata, ControllerConfig())
        read(reader)
        far = {"position": (0.1 + moved, 0.2), "stamp": stamp, "received": received}
        assert rejection(reader, implausible=True, **far) == "position jump"


def test_a_stamp_that_repeats_or_runs_backwards_is_implausible(reader):
    read(reader, stamp=5.0)
    assert rejection(reader, stamp=5.0, implausible=True) == "stamp repeated"
    assert rejection(reader, stamp=4.99, implausible=True) == "stamp backwards"
    assert_reads(reader, state(stamp=5.0), [0.1, 0.2], [0.3, 0.4])


def test_a_source_whose_clock_was_set_back_is_heard_again_at_the_next_state(reader):
    read(reader, stamp=5000.0)
    assert rejection(reader, stamp=1.0, implausible=True) == "stamp backwards"
    assert_reads(reader, state(stamp=1.02), [0.1, 0.2], [0.3, 0.4])


@pytest.mark.parametrize("velocity", [(7.6, 0.0), (0.0, -7.6), (1e300, 0.0)])
def test_a_velocity_that_no_joint_can_have_is_implausible(reader, velocity):
    assert rejection(reader, velocity=velocity, implausible=True) == "velocity implausible"


numbers = st.floats() | st.floats(-1, 1) | st.sampled_from([0.0, 0.1, 1e308, -1e308, 5e-324])
states = st.builds(
    JointState,
    st.sampled_from([NAMES, NAMES[::-1], ("joint1",), ("joint1", "joint1"), ("x", *NAMES), ()]) | st.lists(st.text()),
    st.lists(numbers, max_size=3),
    st.lists(numbers, max_size=3),
    numbers,
)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@given(st.lists(states, max_size=5))
@example([JointState(NAMES, (0.0, 0.0), (), 0.0), JointState(NAMES, (1e-9, 0.0), (), 5e-324)])
@example([JointState(NAMES, (0.0, -1e308), (), 0.0), JointState(NAMES, (0.0, 1e308), (), 0.02)])
def test_whatever_comes_is_rejected_or_read_as_finite_plausible_numbers(metadata, messages):
    joint_reader = JointReader(metadata, ControllerConfig(allow_velocity_estimate=True))
    for message in messages:
        try:
            heard = joint_reader.read(message, message.stamp)
        except JointStateError:
            continue
        if heard is not None and heard.complete:
            assert np.isfinite(joint_reader.position).all()
            assert (np.abs(joint_reader.velocity) <= 7.5).all()
