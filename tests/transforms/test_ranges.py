import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from physai.physics import ParameterLayout
from physai.robots import RobotSpec
from physai.transforms import GrowingRandomization, Ranges
from tests.composed import env_config, randomization


@pytest.fixture(scope="module")
def layout():
    return ParameterLayout(RobotSpec.from_config(env_config("reacher").robot))


@pytest.fixture(scope="module")
def wide():
    return randomization("wide")


@pytest.fixture
def ranges(layout, wide):
    return Ranges(wide, layout)


def test_they_begin_as_the_robot_is_described_and_end_as_the_randomization_says(ranges, layout):
    rows = torch.rand(50, len(layout.nominal))
    torch.testing.assert_close(ranges.present.apply(rows, layout), layout.nominal.repeat(50, 1))
    ranges.move(torch.ones(len(ranges.sides)))
    assert ranges.present == ranges.config


def test_a_robot_as_described_at_one_end_of_a_range_leaves_it_one_side(ranges):
    assert ("link_mass", "low") in ranges.sides
    assert ("payload", "high") in ranges.sides
    assert ("payload", "low") not in ranges.sides


def test_what_is_not_uniform_between_two_numbers_is_drawn_as_it_is(layout):
    ranges = Ranges(randomization("strong"), layout)
    assert ranges.fixed == ["encoder_offset"]
    assert ranges.present.encoder_offset == ranges.config.encoder_offset


@given(data=st.data())
def test_wherever_its_sides_are_a_range_is_within_the_whole_one_and_not_inverted(layout, wide, data):
    ranges = Ranges(wide, layout)
    share = data.draw(st.lists(st.floats(-1, 2), min_size=len(ranges.sides), max_size=len(ranges.sides)))
    ranges.move(torch.tensor(share, dtype=torch.float64))
    for name, ends in ranges.ends.items():
        whole = ranges.config.draws[name]
        assert whole.low <= ends["low"] <= ends["high"] <= whole.high


def test_pinned_robots_stand_on_a_boundary_of_one_parameter_and_say_which(ranges, layout):
    ranges.move(torch.linspace(0.2, 0.8, len(ranges.sides)))
    transform = GrowingRandomization(ranges, 0.4, layout, 2000, 0)
    drawn = transform._reset_env_preprocess(None)["physics_parameters"]
    side = ranges.on_boundary(transform.boundary[:, 0])
    counts = torch.bincount(side, minlength=len(ranges.sides) + 1)
    assert counts[-1].item() == pytest.approx(1200, abs=100)
    assert counts[:-1].min() > 20
    for number, (name, end) in enumerate(ranges.sides):
        at = float(torch.tensor(ranges.ends[name][end]))
        if name == "actuator_delay":
            at = round(at)
        columns, draw = layout.columns[name], ranges.config.draws[name]
        values = drawn[:, columns] / (layout.nominal[columns] if draw.operation == "scale" else 1.0)
        torch.testing.assert_close(values[side == number], torch.full_like(values[side == number], at))
        if name != "actuator_delay":
            assert not torch.isclose(values[side != number], torch.tensor(at)).all(dim=1).any()


def test_a_boundary_that_has_moved_since_is_none(ranges, layout):
    boundary = ranges.pin(torch.rand(500, len(layout.nominal)), 1.0, torch.Generator())
    before = ranges.on_boundary(boundary)
    assert (before < len(ranges.sides)).all()
    share = ranges.share.clone()
    share[3] = 0.1
    ranges.move(share)
    assert torch.equal(ranges.on_boundary(boundary), torch.where(before == 3, len(ranges.sides), before))


def test_only_rows_that_begin_an_episode_get_another_boundary(ranges, layout):
    transform = GrowingRandomization(ranges, 1.0, layout, 100, 0)
    transform._reset_env_preprocess(None)
    handed_out, before = transform.boundary, transform.boundary.clone()
    rows = torch.arange(100)[:, None] < 50
    transform._reset_env_preprocess(TensorDict({"_reset": rows}, batch_size=[100]))
    assert torch.equal(handed_out, before)  # it may live on in a batch
    assert torch.equal(transform.boundary[50:], before[50:])
    assert not torch.equal(transform.boundary[:50], before[:50])
