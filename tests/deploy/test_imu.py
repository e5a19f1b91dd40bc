"""Readings of an IMU: where down is, and what is refused."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physai.deploy import Imu
from physai.deploy.imu import ImuError, ImuReader

GOOD = Imu((0.0, 0.0, 0.0, 1.0), (0.1, 0.2, 0.3), 10.0, "trunk")


@pytest.fixture
def reader():
    return ImuReader("trunk", 0.1)


def test_it_tells_where_down_is_and_how_far_the_base_leans(reader):
    turn = Rotation.from_euler("ZYX", [2.0, 0.3, -0.2])
    reader.read(Imu(tuple(turn.as_quat()), (0.1, 0.2, 0.3), 10.0, "trunk"), 1.0, 0.0)
    np.testing.assert_allclose(reader.gravity, turn.inv().apply([0.0, 0.0, -1.0]), atol=1e-12)
    assert reader.tilt == pytest.approx(math.acos(turn.as_matrix()[2, 2]))
    assert reader.angular_velocity.tolist() == [0.1, 0.2, 0.3]
    assert reader.received == 1.0


@pytest.mark.parametrize(
    ("kind", "changes", "implausible"),
    [
        ("malformed", {"orientation": (0.0, 0.0, 1.0)}, False),
        ("malformed", {"orientation": ("0", "0", "0", "1")}, False),
        ("malformed", {"angular_velocity": None}, False),
        ("malformed", {"stamp": "10"}, False),
        ("malformed", {"frame": np.array(["trunk", "trunk"])}, False),
        ("malformed", {"stamp": math.nan}, False),
        ("not finite", {"angular_velocity": (0.0, math.inf, 0.0)}, False),
        ("not finite", {"orientation": (math.nan, 0.0, 0.0, 1.0)}, False),
        ("not a rotation", {"orientation": (0.0, 0.0, 0.0, 0.0)}, False),
        ("wrong frame", {"frame": "imu_link"}, False),
        ("stamp", {"stamp": 10.0}, True),
        ("stamp", {"stamp": 9.0}, True),
        ("implausible", {"angular_velocity": (0.0, -50.0, 0.0)}, True),
    ],
)
def test_what_cannot_be_used_is_refused_and_the_last_good_one_stays(reader, kind, changes, implausible):
    reader.read(GOOD, 1.0, 0.0)
    with pytest.raises(ImuError) as raised:
        reader.read(Imu(**vars(GOOD) | {"stamp": 10.1} | changes), 1.1, 0.0)
    assert raised.value.kind == kind
    assert raised.value.implausible is implausible
    assert reader.received == 1.0


def test_what_is_no_reading_at_all_is_refused(reader):
    with pytest.raises(ImuError, match="it does not hold four and three numbers"):
        reader.read(None, 1.0, 0.0)


@pytest.mark.fault("numbers of the IMU that stay the same for `state_timeout` while joints move")
def test_numbers_that_stay_the_same_while_joints_move_are_those_of_a_frozen_sensor(reader):
    def read(number, speed):
        reader.read(Imu(**vars(GOOD) | {"stamp": 10.0 + 0.02 * number}), 1.0 + 0.02 * number, speed)

    for number in range(50):
        read(number, speed=0.1)  # of a robot that stands they may
    for number in range(50, 54):
        read(number, speed=2.0)
    with pytest.raises(ImuError, match=r"its orientation is the same for 0\.1\d s, and joints move") as raised:
        read(55, speed=2.0)
    assert raised.value.implausible


def test_an_orientation_that_stays_the_same_beside_rates_that_change_is_frozen(reader):
    def read(number):
        turns = (0.1 * number, 0.0, 0.0)
        reader.read(Imu(GOOD.orientation, turns, 10.0 + 0.02 * number, "trunk"), 1.0 + 0.02 * number, 2.0)

    for number in range(5):
        read(number)
    with pytest.raises(ImuError, match="its orientation is the same"):
        read(7)
