"""Pictures of a curriculum: how the ranges of the randomization grew."""

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from physai.errors import UserError
from physai.physics import RandomizationConfig
from physai.plots.stress import label

_COLUMNS = 5


def plot_curriculum(run: Path, whole: RandomizationConfig, output: Path) -> None:
    """Draw each range that grew over frames, a band from its low to its high end, and the ends it could reach (dashed).

    Args:
        run: The run folder.
        whole: The run's randomization.
        output: The PNG to write.

    Raises:
        UserError: If the run has no ranges to draw.
    """
    path = run / "metrics.csv"
    try:
        metrics = pd.read_csv(path)
        names = [key.split("/")[1] for key in metrics if key.startswith("curriculum/") and key.endswith("/low")]
        bands = {name: (metrics[f"curriculum/{name}/low"], metrics[f"curriculum/{name}/high"]) for name in names}
        draws = {name: whole.draws[name].model_dump() for name in names}
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{path}: the run's metrics are missing or damaged") from error
    if not names:
        raise UserError(f"{run}: no range has grown there")
    rows = -(-len(names) // _COLUMNS)
    figure = Figure(figsize=(3.2 * _COLUMNS, 2.9 * rows), layout="constrained")
    axes = figure.subplots(rows, _COLUMNS, squeeze=False, sharex=True).flat
    for axis, (name, (low, high)) in zip(axes, bands.items(), strict=False):
        draw = draws[name]
        axis.fill_between(metrics["frames"], low, high, step="post", alpha=0.3, linewidth=0)
        for end in (low, high):
            axis.step(metrics["frames"], end, where="post", color="tab:blue", linewidth=1.5)
        for end in (draw["low"], draw["high"]):
            axis.axhline(end, color="0.5", linestyle="--", linewidth=1)
        if draw["distribution"] == "log_uniform":
            axis.set_yscale("log")
        quantity, _, unit = label(name, draw["operation"]).partition(", ")
        axis.set_title(
            quantity + (f" ({'scale' if draw['operation'] == 'scale' else unit})" if unit else ""), fontsize=10
        )
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in list(axes)[len(names) :]:
        axis.set_visible(False)
    figure.supxlabel("frames")
    figure.suptitle("Ranges that robots are drawn from, and the ends that these can reach (dashed)")
    figure.savefig(output, dpi=110)
