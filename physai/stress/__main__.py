"""``python -m physai.stress``: find out where a policy stops to work (see ``--help``)."""

import contextlib
import json
from pathlib import Path
from typing import Annotated

from omegaconf import DictConfig
from pydantic import Field
from rich.table import Table

from physai import cli
from physai.cli.tables import show
from physai.config import Count, Seed, validate
from physai.errors import UserError
from physai.evaluate import PolicyChoice
from physai.files import write_atomically
from physai.stress.axes import Axis, AxisConfig
from physai.stress.run import Breaks, Map, StressTest
from physai.training.run import TrainedPolicy


class StressConfig(PolicyChoice):
    """``conf/stress.yaml``."""

    run: str | Annotated[list[str], Field(min_length=1)]
    x: str
    y: str
    grid: Annotated[Count, Field(ge=2)]
    episodes: Count
    breaks: bool
    box: bool
    output: str | None
    seed: Seed
    axes: dict[str, AxisConfig]

    @property
    def runs(self) -> list[str]:
        """The run folders."""
        return [self.run] if isinstance(self.run, str) else self.run

    def axis(self, name: str, policy: TrainedPolicy) -> Axis:
        """An axis, for the robots of a policy."""
        return Axis.make(name, self.axes, policy.config.env)

    def others(self, policy: TrainedPolicy) -> list[Axis]:
        """All axes that the robots of a policy have."""
        found = []
        for name in self.axes:
            with contextlib.suppress(UserError):
                found.append(self.axis(name, policy))
        return found


def _check(node: DictConfig) -> None:
    config = validate(StressConfig, node)
    if config.x == config.y:
        raise UserError(f"x and y are both '{config.x}'")
    if config.output is not None and Path(config.output).suffix != ".png":
        raise UserError(f"output: '{config.output}' must end in .png")
    for run in config.runs:
        policy = config.load(run)
        if not policy.config.env.simulated:
            raise UserError("physics: only simulated robots can be given other parameters")
        for name in (config.x, config.y):
            config.axis(name, policy)


def _stress(node: DictConfig, _: Path) -> None:
    from physai.plots.stress import plot_maps

    config = validate(StressConfig, node)
    if config.box:
        _box(config)
        return
    maps: dict[str, Map] = {}
    name = f"stress_{config.x}_{config.y}"
    for run in config.runs:
        policy = config.load(run)
        x, y = (config.axis(axis, policy) for axis in (config.x, config.y))
        with StressTest(policy, config.episodes, config.seed, run) as test:
            found = maps[run] = test.map(x, y, config.grid)
            breaks = test.breaks(config.others(policy)) if config.breaks else {}
        summary = {
            "run": run,
            "checkpoint": config.checkpoint,
            "env": policy.config.env.name,
            "physics": policy.config.env.physics,
            "randomization": policy.randomization.name,
            "seed": config.seed,
            **found.summary(),
            "breaks": breaks,
        }
        path = Path(run) / f"{name}.json"
        write_atomically(path, json.dumps(summary, indent=2).encode())
        if breaks:
            _show(run, breaks, config, policy)
    output = Path(config.output or (Path(config.runs[0]) if len(maps) == 1 else Path()) / f"{name}.png")
    plot_maps(maps, output)
    print(f"Map: {output}; figures: {', '.join(str(Path(run) / name) + '.json' for run in maps)}")


def _box(config: StressConfig) -> None:
    table = Table(title="Boxes in which 95 % of the robots settle", title_justify="left")
    for column in ("run", "of the ranges of", "share", "volume", "settled"):
        table.add_column(column)
    for run in config.runs:
        with StressTest(config.load(run), config.episodes, config.seed, run) as test:
            box = test.box()
        settled = f"{box.settled:,} of {box.robots:,}"
        table.add_row(run, box.randomization, f"{box.share:.3f}", f"{box.volume:.3g}", settled)
        summary = {"run": run, "checkpoint": config.checkpoint, "seed": config.seed, **box.summary()}
        write_atomically(Path(run) / f"box_{box.randomization}.json", json.dumps(summary, indent=2).encode())
    show(table)


def _show(run: str, breaks: Breaks, config: StressConfig, policy: TrainedPolicy) -> None:
    title = f"{run}: where less than 95 % work, each parameter alone"
    table = Table(title=title, title_justify="left")
    table.add_column("parameter")
    for column in ("trained", "tried", "success", "settled"):
        table.add_column(column, justify="right")
    for name, found in breaks.items():
        axis = config.axis(name, policy)
        trained = axis.trained(policy.config.randomization, policy.config.env)
        table.add_row(
            f"{name} ({axis.operation})",
            " to ".join(f"{value:.3g}" for value in dict.fromkeys(trained)),
            f"{axis.low:g} to {axis.high:g}",
            *(_beyond(found[what]) for what in ("success", "settled")),
        )
    show(table)


def _beyond(ends: list[float | None]) -> str:
    said = [f"{sign} {end:.3g}" for sign, end in zip("<>", ends, strict=True) if end is not None]
    return ", ".join(said) or "nowhere"


if __name__ == "__main__":
    cli.main("stress", _stress, _check)
