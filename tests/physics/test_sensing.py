"""Encoders with an offset and noise, for simulated robots and for a virtual one."""

import pytest
import torch

from physai.physics import ParameterLayout, SensorErrors

ROBOTS = 2000


@pytest.fixture(scope="module")
def layout(planar):
    return ParameterLayout(planar)


def parameters_of(layout, rows=ROBOTS, **values):
    parameters = layout.nominal.repeat(rows, 1)
    for name, value in values.items():
        parameters[:, layout.columns[name]] = torch.as_tensor(value).float()
    return parameters


def read(layout, parameters, seed=0, dtype=torch.float32):
    position = torch.linspace(-3, 3, 2 * len(parameters), dtype=dtype).reshape(-1, 2)
    velocity = position.flip(0)
    found = SensorErrors(layout)(position, velocity, parameters, torch.Generator().manual_seed(seed))
    return tuple(reading - true for reading, true in zip(found, (position, velocity), strict=True))


def test_perfect_sensors_report_the_truth(layout):
    for error in read(layout, parameters_of(layout)):
        assert not error.any()


def test_an_offset_is_each_joint_s_own_and_touches_no_velocity(layout):
    position, velocity = read(layout, parameters_of(layout, encoder_offset=[0.25, -0.5]))
    torch.testing.assert_close(position, torch.tensor([[0.25, -0.5]]).expand(ROBOTS, 2), rtol=0, atol=1e-6)
    assert not velocity.any()


def test_noise_has_the_standard_deviation_of_the_robot_and_is_independent(layout):
    position, velocity = read(layout, parameters_of(layout, position_noise=0.02, velocity_noise=0.3))
    assert position.std() == pytest.approx(0.02, rel=0.05)
    assert velocity.std() == pytest.approx(0.3, rel=0.05)
    errors = torch.cat([position, velocity], dim=1)
    assert (torch.corrcoef(errors.T) - torch.eye(4)).abs().max() < 0.08
    assert errors.mean(dim=0).abs().max() < 0.03


def test_only_robots_with_noise_have_it(layout):
    noise = torch.zeros(ROBOTS, 1)
    noise[::2] = 0.1
    position, velocity = read(layout, parameters_of(layout, position_noise=noise))
    assert position[::2].all()
    assert not position[1::2].any()
    assert not velocity.any()


def test_readings_follow_the_generator(layout):
    parameters = parameters_of(layout, position_noise=0.02, velocity_noise=0.3)
    first, again, other = (torch.cat(read(layout, parameters, seed)) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.isclose(first, other).all()


def test_readings_have_the_precision_of_what_is_measured(layout):
    parameters = parameters_of(layout, position_noise=0.02, velocity_noise=0.3).double()
    assert all(error.dtype == torch.float64 for error in read(layout, parameters, dtype=torch.float64))
