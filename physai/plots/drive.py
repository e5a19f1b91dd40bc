"""Pictures of drives: where an arm went; no ROS in here."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Annulus, Circle
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from omegaconf import DictConfig
from scipy.spatial.transform import Rotation

from physai.config import validate
from physai.deploy import Policy
from physai.envs.simulation import EnvConfig
from physai.robots import ForwardKinematics, RobotSpec
from physai.signals import Quantity, Ring

if TYPE_CHECKING:
    from physai.ros.driving.goal_client import Record


def draw_drive(record: "Record", policy: Policy, output: Path) -> None:
    """Draw the end effector's path with goals that are places (left), and its errors over time (right).

    A path among goals in the plane, or among configurations, is seen from above, one among goals in space as it is.

    Args:
        record: At least one goal.
        policy: The policy that drove.
        output: The PNG to write.
    """
    figure = Figure(figsize=(12, 5.4), layout="constrained")
    goal, grid = policy.metadata.goal, figure.add_gridspec(1, 2, width_ratios=[1, 1.25])
    in_space = goal.quantity in (Quantity.POSITION, Quantity.POSE) and goal.size > 2
    where = figure.add_subplot(grid[0], projection="3d" if in_space else None)
    over = figure.add_subplot(grid[1])
    (_draw_path_in_space if in_space else _draw_path)(figure, where, record, policy)
    _draw_errors(over, record, policy)
    figure.savefig(output, dpi=120)


def _path(record: "Record", policy: Policy) -> tuple[ForwardKinematics, np.ndarray, np.ndarray]:
    """The robot's kinematics; since the first goal was sent, times, s, [T], and its end effector, m, [T, 3]."""
    config = validate(EnvConfig, DictConfig(policy.metadata.raw["config"]["env"]))
    kinematics = ForwardKinematics(RobotSpec.from_config(config.robot))
    times, positions = np.array(record.times), np.array(record.positions)
    moving = times >= record.results[0].sent
    points = kinematics(torch.from_numpy(positions[moving]).float()).numpy()
    return kinematics, times[moving] - record.results[0].sent, points


def _draw_path_in_space(figure: Figure, axes: Any, record: "Record", policy: Policy) -> None:
    metadata = policy.metadata
    _, times, points = _path(record, policy)
    path = Line3DCollection(np.stack([points[:-1], points[1:]], axis=1), cmap="viridis", linewidth=1.5)
    path.set_array(times[:-1])
    axes.add_collection(path)
    for number, result in enumerate(record.results, 1):
        x, y, z = result.goal[:3]
        axes.scatter([x], [y], [z], s=60, alpha=0.6, color="tab:green" if result.kept else "tab:red")
        axes.text(x, y, z, f" {number}", fontsize=9, color="0.2")
        if metadata.goal.quantity is Quantity.POSE:
            turned = Rotation.from_quat(result.goal[3:]).as_matrix().T
            for axis, color in zip(turned, ("tab:red", "tab:green", "tab:blue"), strict=True):
                axes.quiver(x, y, z, *(0.08 * axis), color=color, linewidth=1.2, arrow_length_ratio=0.0)
    around = np.concatenate([points, [result.goal[:3] for result in record.results], np.zeros((1, 3))])
    low, high = around.min(axis=0) - 0.05, around.max(axis=0) + 0.05
    axes.plot([0, 0], [0, 0], [low[2], 0], "s-", color="0.2", markersize=7)
    axes.text(0, 0, 0, " base", color="0.2")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    axes.set_box_aspect(high - low)
    axes.set_title(f"Path of the end effector of '{metadata.robot}' among {len(record.results)} goals")
    figure.colorbar(path, ax=axes, label="time (s)", shrink=0.8)


def _draw_path(figure: Figure, axes: Axes, record: "Record", policy: Policy) -> None:
    metadata = policy.metadata
    kinematics, times, points = _path(record, policy)
    points = points[:, :2]
    widest = 1.15 * kinematics.reach
    if isinstance(metadata.region, Ring):
        outer = metadata.region.outer
        widest = 1.15 * outer
        axes.add_patch(Annulus((0, 0), outer, outer - metadata.region.inner, color="0.94", zorder=0))
    if metadata.goal.quantity is Quantity.POSITION:
        for number, result in enumerate(record.results, 1):
            color = "tab:green" if result.kept else "tab:red"
            where, size = (result.goal[0], result.goal[1]), metadata.tolerances[0].value
            axes.add_patch(Circle(where, size, facecolor=color, alpha=0.25, edgecolor=color))
            axes.annotate(str(number), where, ha="center", va="center", fontsize=9, color="0.2")
    path = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap="viridis", linewidth=1.5)
    path.set_array(times[:-1])
    axes.add_collection(path)
    axes.plot(0, 0, "s", color="0.2", markersize=7)
    axes.annotate("base", (0, 0), xytext=(6, 6), textcoords="offset points", color="0.2")
    axes.set(aspect="equal", xlim=(-widest, widest), ylim=(-widest, widest), xlabel="x (m)", ylabel="y (m)")
    axes.set_title(f"Path of the end effector of '{metadata.robot}' among {len(record.results)} goals")
    figure.colorbar(path, ax=axes, label="time (s)", shrink=0.8)


def _draw_errors(axes: Axes, record: "Record", policy: Policy) -> None:
    tolerances, times, started = policy.metadata.tolerances, np.array(record.times), record.results[0].sent
    scale = np.array([tolerance.value for tolerance in tolerances])
    ends = [result.sent for result in record.results[1:]] + [times[-1]]
    for number, (result, end) in enumerate(zip(record.results, ends, strict=True), 1):
        rows = np.flatnonzero((times >= result.sent) & (times < end))
        errors = [np.max(policy.error(record.positions[row], result.goal) / scale) for row in rows]
        axes.plot(times[rows] - started, errors, color="tab:blue", linewidth=1.5)
        axes.axvline(result.sent - started, color="0.85", linewidth=1, zorder=0)
        axes.annotate(str(number), (result.sent - started, 1.0), xycoords=("data", "axes fraction"), fontsize=9)
        if result.reached is not None:
            axes.axvspan(result.reached - started, end - started, color="tab:green", alpha=0.12, linewidth=0)
    axes.axhline(1.0, color="tab:green", linestyle="--", linewidth=1)
    names = ", ".join(dict.fromkeys(f"{one.value:g} {one.unit}" for one in tolerances))
    axes.set(xlabel="time (s)", ylabel=f"error / tolerance ({names})", ylim=(0, None), xlim=(0, times[-1] - started))
    axes.set_title("Error at the goal; shaded: reached", pad=18)
    axes.spines[["top", "right"]].set_visible(False)
