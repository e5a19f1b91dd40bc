"""Training curves."""

import pytest

from physai import UserError
from physai.plots import runs

HEADER = "frame,return,length\n"


def write(folder, rows):
    folder.mkdir()
    (folder / "episodes.csv").write_text(HEADER + rows)
    return folder


def test_each_run_has_a_curve_of_its_return_and_one_of_its_length(tmp_path, drawn):
    rows = "".join(f"{frame},{frame / 100 - 50},{200 - frame / 100}\n" for frame in range(100, 10_000, 100))
    both = [write(tmp_path / name, rows) for name in ("one", "other")]
    runs.plot_runs(both, tmp_path / "training.png")
    assert (tmp_path / "training.png").read_bytes().startswith(b"\x89PNG")
    for axis, rises in zip(drawn().axes[:2], (True, False), strict=True):
        labels = [line.get_label() for line in axis.lines]
        assert labels == [f"{name}: mean, 10th to 90th percentile" for name in ("one", "other")]
        first, *_, last = axis.lines[0].get_ydata()
        assert (last > first) == rises


def test_success_and_settled_of_the_evaluations_are_drawn_in_the_run_s_color(tmp_path, drawn):
    run = write(tmp_path / "run", "100,-5,60\n200,-4,50\n")
    (run / "metrics.csv").write_text(
        "frames,evaluation/success_rate,evaluation/settled_rate\n100,,\n150,0.5,0.25\n200,1.0,0.75\n"
    )
    runs.plot_runs([run], tmp_path / "training.png")
    success, settled = drawn().axes[2].lines
    assert success.get_xydata().tolist() == [[150, 50], [200, 100]]
    assert settled.get_xydata().tolist() == [[150, 25], [200, 75]]
    assert success.get_color() == settled.get_color() == drawn().axes[0].lines[0].get_color()


@pytest.mark.parametrize(
    ("rows", "message"), [("", "no episode has ended yet"), ("1,zero,3\n", "the run's episodes are damaged")]
)
def test_a_run_without_episodes_to_draw_is_named(tmp_path, rows, message):
    with pytest.raises(UserError, match=message):
        runs.plot_runs([write(tmp_path / "run", rows)], tmp_path / "training.png")
    assert not (tmp_path / "training.png").exists()


def test_what_is_no_run_is_named(tmp_path):
    with pytest.raises(UserError, match="no run there"):
        runs.plot_runs([tmp_path], tmp_path / "training.png")
