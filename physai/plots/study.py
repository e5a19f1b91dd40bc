"""Pictures of studies: values of trials, and what they go together with."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator


def plot_study(trials: Any, objective: str, minimize: bool, names: Mapping[str, str], output: Path) -> None:
    """Draw the value of every trial (left), and how the parameters go together with it (right).

    Args:
        trials: A DataFrame with the columns ``run``, ``objective`` (NaN: it came to no end) and the parameters.
        objective: What the value of a trial is.
        minimize: Whether the best is the smallest.
        names: The parameters, and what to call them.
        output: The PNG to write.
    """
    ended = trials[np.isfinite(trials[objective].astype(float))]
    best = ended[objective].cummin() if minimize else ended[objective].cummax()
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.scatter(ended["run"], ended[objective], s=22, alpha=0.7, label="trials")
    left.step(ended["run"], best, where="post", linewidth=2, color="tab:orange", label="best so far")
    lost = trials["run"].drop(ended.index)
    left.plot(lost, np.zeros(len(lost)), "x", color="tab:red", transform=left.get_xaxis_transform(), clip_on=False,
              label="no value")  # fmt: skip
    left.set_title(objective.capitalize())
    left.set_xlabel("trial")
    left.xaxis.set_major_locator(MaxNLocator(integer=True))
    left.legend(frameon=False)
    ranks = ended[[objective, *names]].rank(numeric_only=True)
    columns = [key for key in names if key in ranks and ranks[key].nunique() > 1]
    together = ranks[columns].corrwith(ranks[objective]).dropna().sort_values(key=abs)
    right.barh([names[key] for key in together.index], together)
    right.set_title("Rank correlation of parameters with it")
    right.set_xlim(-1, 1)
    right.axvline(0, color="black", linewidth=0.8)
    for axis in (left, right):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(output, dpi=130)
