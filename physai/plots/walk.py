"""A picture of a walk: where a robot on legs went; no ROS in here."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

if TYPE_CHECKING:
    from physai.ros.driving.square_client import Walk


def draw_walk(walk: "Walk", robot: str, near: float, output: Path) -> None:
    """Draw a path among corners, seen from above.

    Args:
        walk: At least one corner, and two poses.
        robot: Name of the robot.
        near: Within which a corner counts, m.
        output: The PNG to write.
    """
    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    axes = figure.add_subplot()
    for corner in walk.corners:
        color = "tab:green" if corner.kept else "tab:red"
        axes.add_patch(Circle(corner.place, near, facecolor=color, alpha=0.12, edgecolor=color, zorder=0))
        axes.plot(*corner.place, "+", color=color, markersize=10)
    points, times = np.array(walk.poses)[:, :2], np.array(walk.times) - walk.times[0]
    path = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap="viridis", linewidth=1.5)
    path.set_array(times[:-1])
    axes.add_collection(path)
    around = np.concatenate([points, [corner.place for corner in walk.corners]])
    low, high = around.min(axis=0) - near - 0.1, around.max(axis=0) + near + 0.1
    axes.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x (m)", ylabel="y (m)")
    axes.set_title(f"Path of '{robot}' past {len(walk.corners)} corners, by its odometry")
    axes.spines[["top", "right"]].set_visible(False)
    figure.colorbar(path, ax=axes, label="time (s)", shrink=0.8)
    figure.savefig(output, dpi=120)
