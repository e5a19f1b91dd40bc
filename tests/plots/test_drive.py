"""Pictures of drives."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from physai.deploy import load_policy
from physai.plots import drive


def test_a_drive_shows_each_goal_in_the_colour_of_its_end_and_the_errors_over_time(exported_run, tmp_path, drawn):
    policy = load_policy(exported_run / "policy.pt")
    times = list(np.linspace(10.0, 14.0, 41))
    positions = [np.array([0.1 * index, 0.5]) for index in range(41)]
    results = [
        SimpleNamespace(goal=np.array([0.3, 0.2]), sent=10.0, reached=11.0, kept=True),
        SimpleNamespace(goal=np.array([-0.2, 0.3]), sent=12.0, reached=None, kept=False),
    ]
    record = SimpleNamespace(results=results, times=times, positions=positions)
    drive.draw_drive(record, policy, tmp_path / "drive.png")
    assert (tmp_path / "drive.png").read_bytes().startswith(b"\x89PNG")
    above, over, _ = drawn().axes
    green, red = (to_rgb(name) for name in ("tab:green", "tab:red"))
    goals = [patch for patch in above.patches if isinstance(patch, drive.Circle)]
    assert [tuple(patch.center) for patch in goals] == [(0.3, 0.2), (-0.2, 0.3)]
    assert [patch.get_facecolor()[:3] for patch in goals] == [green, red]
    curves = [line for line in over.lines if len(line.get_xdata()) > 2]
    assert len(curves) == 2
    expected = policy.error(positions[0], results[0].goal)[0] / policy.metadata.tolerances[0].value
    assert curves[0].get_ydata()[0] == pytest.approx(expected)
