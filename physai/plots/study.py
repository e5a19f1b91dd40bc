"""Pictures of studies: values of trials, and what they go together with."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

if TYPE_CHECKING:
    import optuna


def plot_study(study: "optuna.Study", objective: str, names: Mapping[str, str], output: Path) -> None:
    """Draw the value of every trial (left), and how the parameters go together with it (right).

    Args:
        study: With at least one trial that has a value.
        objective: What that value is.
        names: What to call its parameters.
        output: The PNG to write.
    """
    trials = study.trials_dataframe(("number", "value", "params"))
    ended = trials[np.isfinite(trials["value"])]
    best = ended["value"].cummax() if study.direction.name == "MAXIMIZE" else ended["value"].cummin()
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    left.scatter(ended["number"], ended["value"], s=22, alpha=0.7, label="trials")
    left.step(ended["number"], best, where="post", linewidth=2, color="tab:orange", label="best so far")
    lost = trials[~np.isfinite(trials["value"])]["number"]
    left.plot(lost, np.zeros(len(lost)), "x", color="tab:red", transform=left.get_xaxis_transform(), clip_on=False,
              label="no value")  # fmt: skip
    left.set_title(objective.capitalize())
    left.set_xlabel("trial")
    left.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(integer=True))
    left.legend(frameon=False)
    ranks = ended.rank(numeric_only=True)
    columns = [f"params_{key}" for key in names if f"params_{key}" in ranks and ranks[f"params_{key}"].nunique() > 1]
    together = ranks[columns].corrwith(ranks["value"]).dropna().sort_values(key=abs)
    right.barh([names[column.removeprefix("params_")] for column in together.index], together)
    right.set_title("Rank correlation of parameters with it")
    right.set_xlim(-1, 1)
    right.axvline(0, color="black", linewidth=0.8)
    for axis in (left, right):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(output, dpi=130)
    plt.close(figure)
