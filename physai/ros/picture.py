"""A picture of where an arm went."""

from pathlib import Path

import matplotlib
import numpy as np
import torch
from omegaconf import DictConfig

from physai.config import validate
from physai.deploy import Metadata
from physai.envs.simulation import EnvConfig
from physai.robots import ForwardKinematics, RobotSpec
from physai.ros.tour import Tour

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.patches import Annulus, Circle


def draw_tour(tour: Tour, metadata: Metadata, output: Path) -> None:
    """Draw the tip's path among the goals (left), and its distance from the goal of the moment over time (right).

    Args:
        tour: At least one visit.
        metadata: Of the policy that drove.
        output: The PNG to write.
    """
    config = validate(EnvConfig, DictConfig(metadata.raw["config"]["env"]))
    kinematics = ForwardKinematics(RobotSpec.from_config(config.robot))
    times = np.array(tour.times)
    tip = kinematics(torch.tensor(np.array(tour.positions), dtype=torch.float32))[:, :2].numpy()
    started = tour.visits[0].sent
    figure, (above, over) = plt.subplots(1, 2, figsize=(12, 5.4), layout="constrained", width_ratios=[1, 1.25])

    inner, outer = metadata.goal_radius
    above.add_patch(Annulus((0, 0), outer, outer - inner, color="0.94", zorder=0))
    for number, visit in enumerate(tour.visits, 1):
        color = "tab:green" if visit.kept else "tab:red"
        above.add_patch(Circle(tuple(visit.goal), visit.tolerance, facecolor=color, alpha=0.25, edgecolor=color))
        above.annotate(str(number), visit.goal, ha="center", va="center", fontsize=9, color="0.2")
    moving = times >= started
    points = tip[moving]
    path = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap="viridis", linewidth=1.5)
    path.set_array(times[moving][:-1] - started)
    above.add_collection(path)
    above.plot(0, 0, "s", color="0.2", markersize=7)
    above.annotate("base", (0, 0), xytext=(6, 6), textcoords="offset points", color="0.2")
    above.set(
        aspect="equal",
        xlim=(-1.15 * outer, 1.15 * outer),
        ylim=(-1.15 * outer, 1.15 * outer),
        xlabel="x (m)",
        ylabel="y (m)",
        title=f"Path of the tip of '{metadata.robot}' among {len(tour.visits)} goals",
    )
    figure.colorbar(path, ax=above, label="time (s)", shrink=0.8)

    ends = [visit.sent for visit in tour.visits[1:]] + [times[-1]]
    for number, (visit, end) in enumerate(zip(tour.visits, ends, strict=True), 1):
        rows = (times >= visit.sent) & (times < end)
        distance = np.linalg.norm(tip[rows] - visit.goal, axis=1)
        over.plot(times[rows] - started, 100 * distance, color="tab:blue", linewidth=1.5)
        over.axvline(visit.sent - started, color="0.85", linewidth=1, zorder=0)
        over.annotate(str(number), (visit.sent - started, 1.0), xycoords=("data", "axes fraction"), fontsize=9)
        if visit.reached is not None:
            over.axvspan(visit.reached - started, end - started, color="tab:green", alpha=0.12, linewidth=0)
    over.axhline(100 * metadata.goal_tolerance, color="tab:green", linestyle="--", linewidth=1)
    over.set(xlabel="time (s)", ylabel="distance from the goal (cm)", ylim=(0, None), xlim=(0, times[-1] - started))
    over.set_title("Distance from the goal; shaded: reached", pad=18)
    over.spines[["top", "right"]].set_visible(False)
    figure.savefig(output, dpi=120)
    plt.close(figure)
