"""What was found of a two-link arm, without the search for it."""

import numpy as np
import pytest

from physai.identify.fit import Fit
from physai.identify.unknowns import Unknowns
from physai.physics import ParameterLayout
from physai.robots import RobotSpec

NAMES = ["link_mass", "payload", "joint_friction", "velocity_gain"]


@pytest.fixture(scope="module")
def planar(reacher):
    return RobotSpec.from_config(reacher.robot)


@pytest.fixture(scope="module")
def layout(planar):
    return ParameterLayout(planar)


@pytest.fixture
def found(planar, layout):
    """The second link is twice as heavy; tool and payload cannot be told apart; one joint's friction does not show."""
    unknowns = Unknowns.of(NAMES, planar, layout)
    size = len(unknowns)
    coordinates, deviation, alone = np.zeros(size), np.full(size, 0.1), np.full(size, 0.1)
    coordinates[1] = np.log(2.0)
    deviation[0] = alone[0] = 1e-4
    deviation[2:4], alone[2:4] = 0.9, 1e-4
    deviation[5] = alone[5] = 1.0
    told, unseen = deviation < 0.3, np.arange(size) == 5
    error = np.full(2, 1e-3)
    return Fit(
        unknowns, coordinates, 1.5, deviation, alone, told, np.zeros((0, size)), unseen, error, error,
        np.zeros((3, 1, 1, 2)), np.array([1e-3, 2e-2]), 1.0, (),
    )  # fmt: skip
