"""Picture of an identification: motions that were not used, and what is known of each parameter."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

_MOTIONS = 3
_MEASURED, _DESCRIBED, _FOUND = {"color": "0.3", "marker": ".", "markersize": 3, "linestyle": ""}, "tab:red", "tab:blue"


@dataclass(frozen=True)
class Identification:
    """What the picture shows.

    Attributes:
        title: Its title.
        period: From step to step, s.
        joints: Names, n.
        held_out: Positions in H motions: measured, as described, as found, rad, [3, T, H, n].
        before: Root mean square errors of the description, rad, [n].
        after: Of what was found, rad, [n].
        labels: Of the parameters, F.
        values: What was found, SI units, [F].
        coordinates: The same in units of what might well have been; 0 is as described, [F].
        deviation: Half of the 95 % intervals, in these units, [F].
        told: Which parameters the data tell, [F].
    """

    title: str
    period: float
    joints: Sequence[str]
    held_out: np.ndarray
    before: np.ndarray
    after: np.ndarray
    labels: Sequence[str]
    values: np.ndarray
    coordinates: np.ndarray
    deviation: np.ndarray
    told: np.ndarray


def plot_identification(shown: Identification, output: Path) -> None:
    """Draw the motions held out in which the robot went farthest, and the intervals of all parameters."""
    joints, parameters = len(shown.joints), len(shown.labels)
    ways = np.nanmax(np.abs(shown.held_out[0] - shown.held_out[0, 0]), axis=(0, 2))
    chosen = np.argsort(-ways)[:_MOTIONS]
    height = max(1.6 * joints, 0.28 * parameters + 0.8, 3.5)
    figure = Figure(figsize=(14, height), layout="constrained")
    figure.suptitle(shown.title)
    left, right = figure.subfigures(1, 2, width_ratios=(3, 2), squeeze=False)[0]
    axes = left.subplots(joints, len(chosen), squeeze=False, sharex="col")
    time = shown.period * np.arange(1, len(shown.held_out[0]) + 1)
    for row, joint in enumerate(shown.joints):
        for column, motion in enumerate(chosen):
            axis = axes[row, column]
            measured, described, found = np.degrees(shown.held_out[:, :, motion, row])
            axis.plot(time, described, color=_DESCRIBED, linewidth=1, label="as described")
            axis.plot(time, found, color=_FOUND, linewidth=1, label="as found")
            axis.plot(time, measured, label="measured", **_MEASURED)
            axis.grid(alpha=0.3)
            if column == 0:
                errors = f"{1e3 * shown.before[row]:.1f} to {1e3 * shown.after[row]:.1f} mrad"
                axis.set_ylabel(f"{joint}, °\n{errors}", fontsize=8)
            axis.tick_params(labelsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("s", fontsize=8)
    axes[0, 0].legend(fontsize=7, loc="best")
    left.suptitle("motions that were held out", fontsize=10)
    _intervals(right, shown)
    figure.savefig(output, dpi=110)


def _intervals(figure: Figure, shown: Identification) -> None:
    axis = figure.subplots()
    figure.suptitle("what is known, with 95 % intervals; 0 is as described", fontsize=10)
    rows = np.arange(len(shown.labels))
    for told, color in ((True, _FOUND), (False, "0.7")):
        chosen = shown.told == told
        axis.errorbar(
            shown.coordinates[chosen], rows[chosen], xerr=np.minimum(shown.deviation[chosen], 2.0), fmt="o",
            markersize=4, color=color, capsize=2, label="told by these motions" if told else "not told alone",
        )  # fmt: skip
    axis.axvline(0.0, color=_DESCRIBED, linewidth=1)
    names = [f"{label} {value:.3g}" for label, value in zip(shown.labels, shown.values, strict=True)]
    axis.set_yticks(rows, names, fontsize=8)
    axis.set_xlabel("units of what might well have been (docs/identify.md)", fontsize=8)
    axis.invert_yaxis()
    axis.grid(alpha=0.3, axis="x")
    axis.legend(fontsize=8)
