"""Pictures of runs: training curves."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from physai import foreign
from physai.errors import UserError

_BINS = 60


def plot_runs(runs: Sequence[Path], output: Path) -> None:
    """Draw episode return and length over frames, smoothed, with their spread; and the evaluations' rates.

    One run shows the mean of its episodes and the band of their 10th to 90th percentile. Runs that differ only in
    their seed become one curve: the mean over runs, in the band from the lowest to the highest of them.

    Args:
        runs: Run folders.
        output: The PNG to write.

    Raises:
        UserError: If a run has no episodes to draw.
    """
    groups: dict[str, list[pd.DataFrame]] = {}
    for run in runs:
        groups.setdefault(_label(run), []).append(_episodes(run))
    figure = Figure(figsize=(15, 4.2), layout="constrained")
    axes = figure.subplots(1, 3)
    for label, members in groups.items():
        _curve(axes[0], members, "return", label)
        _curve(axes[1], members, "length", label)
    colors = {label: line.get_color() for label, line in zip(groups, axes[0].lines, strict=True)}
    for run in runs:
        _rates(axes[2], run, colors[_label(run)])
    axes[2].set_ylim(-2, 102)
    titles = "Episode return", "Episode length (steps)", "Success (solid) and settled (dashed), % of test goals"
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title)
        axis.set_xlabel("frames")
        axis.grid(alpha=0.25)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.spines[["top", "right"]].set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    columns = max(1, min(3, 120 // max(map(len, labels), default=1)))  # what fits beside each other
    figure.legend(handles, labels, loc="outside lower center", ncols=min(columns, len(labels)), frameon=False)
    figure.savefig(output, dpi=130)


def _episodes(run: Path) -> pd.DataFrame:
    path = run / "episodes.csv"
    if not path.is_file():
        raise UserError(f"{run}: no run there (it has no episodes.csv)")
    foreign.check_links(run)
    try:
        episodes = pd.read_csv(path)[["frame", "return", "length"]].astype(float)
    except (ValueError, KeyError) as error:
        raise UserError(f"{path}: the run's episodes are damaged") from error
    if episodes.empty:
        raise UserError(f"{run}: no episode has ended yet, there is nothing to draw")
    return episodes


def _rates(axis: Axes, run: Path, color: str) -> None:
    """What the evaluations while training found; a run may not have had one yet."""
    path = run / "metrics.csv"
    if not path.is_file():
        return
    columns = {"evaluation/success_rate": "-", "evaluation/settled_rate": "--"}
    try:
        metrics = pd.read_csv(path, usecols=["frames", *columns]).astype(float).dropna()
    except ValueError as error:
        raise UserError(f"{path}: the run's metrics are damaged") from error
    for column, style in columns.items():
        axis.plot(metrics["frames"], 100 * metrics[column], style, marker=".", color=color, linewidth=1.5)


def _label(run: Path) -> str:
    """What a run is, but for its seed: runs with equal labels are repetitions."""
    if not (run / ".hydra" / "config.yaml").is_file():
        return run.name
    rest = [item for item in foreign.read_overrides(run) if not item.startswith(("seed=", "env="))]
    return ", ".join([foreign.read_name(run), *rest])


def _curve(axis: Axes, members: list[pd.DataFrame], column: str, label: str) -> None:
    edges = np.linspace(0, max(episodes["frame"].max() for episodes in members), _BINS + 1)
    centers = (edges[1:] + edges[:-1]) / 2
    binned = [episodes.groupby(pd.cut(episodes["frame"], edges), observed=False)[column] for episodes in members]
    means = pd.DataFrame([_smooth(groups.mean()).to_numpy() for groups in binned])
    if len(members) == 1:
        low, high = (_smooth(binned[0].quantile(q)).to_numpy() for q in (0.1, 0.9))
        name = f"{label}: mean, 10th to 90th percentile"
    else:
        low, high = means.min().to_numpy(), means.max().to_numpy()
        name = f"{label}: mean and range of {len(members)} runs"
    (line,) = axis.plot(centers, means.mean().to_numpy(), linewidth=2, label=name)
    axis.fill_between(centers, low, high, alpha=0.2, color=line.get_color(), linewidth=0)


def _smooth(values: pd.Series) -> pd.Series:
    return values.interpolate(limit_direction="both").rolling(3, center=True, min_periods=1).mean()
