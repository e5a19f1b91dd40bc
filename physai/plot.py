"""``python -m physai.plot``: draw training curves (see ``--help``)."""

from pathlib import Path

from omegaconf import DictConfig
from pydantic import Field

from physai import cli
from physai.config import Config, validate
from physai.errors import UserError


class PlotConfig(Config):
    """``conf/plot.yaml``."""

    runs: list[str] = Field(min_length=1)
    output: str | None


def _check(node: DictConfig) -> None:
    validate(PlotConfig, node)


def _plot(node: DictConfig, _: Path) -> None:
    from physai.plots.runs import plot_runs

    config = validate(PlotConfig, node)
    runs = [Path(run) for run in config.runs]
    output = Path(config.output) if config.output else (runs[0] if len(runs) == 1 else Path()) / "training.png"
    try:
        plot_runs(runs, output)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot write {output}: {error}") from error
    print(f"Curves: {output}")


if __name__ == "__main__":
    cli.main("plot", _plot, _check)
