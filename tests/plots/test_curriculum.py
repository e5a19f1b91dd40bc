"""How ranges grew."""

import pytest

from physai import UserError
from physai.plots.curriculum import plot_curriculum
from tests.composed import randomization


@pytest.fixture(scope="module")
def wide():
    return randomization("wide")


def test_each_range_is_a_band_between_the_ends_that_it_can_reach(wide, tmp_path, drawn):
    columns = [f"curriculum/{name}/{end}" for name in ("link_mass", "payload") for end in ("low", "high")]
    rows = ["100,1,1,0,0", "200,0.8,1.2,0,0.5"]
    (tmp_path / "metrics.csv").write_text("\n".join([",".join(["frames", *columns]), *rows, ""]))
    plot_curriculum(tmp_path, wide, tmp_path / "curriculum.png")
    assert (tmp_path / "curriculum.png").read_bytes().startswith(b"\x89PNG")
    mass, payload, *_ = drawn().axes
    assert (mass.get_title(), payload.get_title()) == ("link mass (scale)", "payload (kg)")
    assert (mass.get_yscale(), payload.get_yscale()) == ("log", "linear")
    assert [list(line.get_ydata()) for line in mass.lines] == [[1, 0.8], [1, 1.2], [0.1, 0.1], [10, 10]]


@pytest.mark.parametrize("text", ["frames\n1\n", "frames,curriculum/payload/low\n1,0\n", None])
def test_a_run_without_ranges_is_named(wide, tmp_path, text):
    if text is not None:
        (tmp_path / "metrics.csv").write_text(text)
    with pytest.raises(UserError, match=str(tmp_path)):
        plot_curriculum(tmp_path, wide, tmp_path / "curriculum.png")
