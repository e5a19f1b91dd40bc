"""Pictures of stress tests: success over two parameters."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

if TYPE_CHECKING:
    from physai.stress.run import Map

_UNITS = {
    "payload": "kg",
    "armature": "kg m²",
    "actuator_delay": "control steps",
    "encoder_offset": "rad",
    "position_noise": "rad",
    "velocity_noise": "rad/s",
    "center_of_mass": "m",
    "push": "m/s",
    "motor_time_constant": "s",
}
_WORKS = 95  # %


def plot_maps(maps: "Mapping[str, Map]", output: Path) -> None:
    """Draw success (left) and settled (right) over two parameters, a row for each run, all on one scale.

    A line surrounds what works for 95 % of the goals, a dashed box what the policy was trained on.

    Args:
        maps: By the name of the run.
        output: The PNG to write.
    """
    figure = Figure(figsize=(11, 0.6 + 4.2 * len(maps)), layout="constrained")
    axes = figure.subplots(len(maps), 2, squeeze=False, sharex=True, sharey=True)
    for row, (run, found) in zip(axes, maps.items(), strict=True):
        for axis, what in zip(row, ("success", "settled"), strict=True):
            mesh = _heat(axis, found, 100 * getattr(found, what) / found.episodes)
            axis.set_title(f"{Path(run).name}: {what}" if len(maps) > 1 else what.capitalize())
        row[0].set_ylabel(label(found.y.name, found.y.operation))
    for axis in axes[-1]:
        axis.set_xlabel(label(found.x.name, found.x.operation))
    figure.colorbar(mesh, ax=axes, label="% of goals", shrink=0.9)
    handles = [
        Line2D([], [], color="black", linewidth=2, label="95 % work"),
        Line2D([], [], color="crimson", linewidth=2, linestyle="--", label="range of the training"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(output, dpi=130)


def _heat(axis: Axes, found: "Map", percent: np.ndarray) -> QuadMesh:
    columns, rows = np.arange(len(found.x_values)), np.arange(len(found.y_values))
    mesh = axis.pcolormesh(columns, rows, percent, cmap="viridis", vmin=0, vmax=100)
    for (row, column), value in np.ndenumerate(percent):
        color = "black" if value > 60 else "white"
        axis.text(column, row, f"{value:.0f}", ha="center", va="center", fontsize=7, color=color)
    if percent.min() < _WORKS <= percent.max():
        axis.contour(columns, rows, percent, levels=[_WORKS], colors="black", linewidths=2)
    (left, right), (bottom, top) = (
        np.interp(trained, values, np.arange(len(values)))
        for trained, values in zip(found.trained, (found.x_values, found.y_values), strict=True)
    )
    size = right - left, top - bottom
    axis.add_patch(Rectangle((left, bottom), *size, fill=False, edgecolor="crimson", linewidth=2, linestyle="--"))
    axis.set_xticks(columns, [f"{value:.3g}" for value in found.x_values])
    axis.set_yticks(rows, [f"{value:.3g}" for value in found.y_values])
    return mesh


def label(name: str, operation: str) -> str:
    """A parameter and its unit, for people."""
    unit = "times what the robot's description says" if operation == "scale" else _UNITS.get(name, "")
    return f"{name.replace('_', ' ')}, {unit}".rstrip(", ")
