"""``python -m physai.identify``: find the robot that moves as a recorded one did (see ``--help``)."""

import json
import sys
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from omegaconf import DictConfig
from pydantic import Field
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from physai import cli
from physai.config import Config, Seed, validate
from physai.envs.simulation import EnvConfig
from physai.errors import UserError
from physai.files import write_atomically
from physai.identify.fit import Fit, Predictor, fit
from physai.identify.recording import read
from physai.identify.trials import Trials, cut
from physai.identify.unknowns import Unknowns
from physai.physics import ParameterLayout
from physai.robots import RobotSpec

_SHOWN = 0.2  # share of a direction below which a parameter is left out of its words


class IdentifyConfig(Config):
    """``conf/identify.yaml``."""

    data: str
    fit: Annotated[list[str], Field(min_length=1)]
    delays: Annotated[int, Field(ge=0, le=20)]
    output: str | None
    command_topic: str
    seed: Seed
    env: dict[str, Any]
    physics: dict[str, Any]

    def robot(self) -> tuple[EnvConfig, RobotSpec, Unknowns]:
        """Return the env, its robot, and what is to be found; raises a UserError if there is none of these."""
        env = validate(EnvConfig, DictConfig(self.env))
        if not env.simulated:
            raise UserError("physics: only a simulated robot can be given other parameters")
        spec = RobotSpec.from_config(env.robot)
        return env, spec, Unknowns.of(self.fit, spec, ParameterLayout(spec))

    def trials(self, env: EnvConfig) -> Trials:
        """Read the data."""
        joints = env.robot.joints
        return cut(read(Path(self.data), joints, env.control_dt, self.command_topic), self.data, joints)

    @property
    def path(self) -> Path:
        """Where the figures go."""
        return Path(self.output or f"{self.data.rstrip('/')}.identified.json")


def _check(node: DictConfig) -> None:
    config = validate(IdentifyConfig, node)
    if config.path.suffix != ".json":
        raise UserError(f"output: '{config.output}' must end in .json")
    env, _, _ = config.robot()
    config.trials(env)


def _identify(node: DictConfig, _: Path) -> None:
    config = validate(IdentifyConfig, node)
    env, spec, unknowns = config.robot()
    trials = config.trials(env)
    console = Console()
    for reason in trials.left_out:
        console.print(f"left out: {reason}", highlight=False, markup=False)
    steps = int(np.isfinite(trials.measured[0]).all(axis=2).sum())
    seconds = steps * env.control_dt
    console.print(
        f"{len(trials)} motions, {seconds:.0f} s; {len(unknowns)} unknowns, delays of 0 to {config.delays} steps"
    )
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with (
        Progress(*columns, transient=True, disable=not sys.stderr.isatty(), console=Console(stderr=True)) as progress,
        closing(Predictor(spec, env.physics, env.control_dt, trials)) as predict,
    ):
        task = progress.add_task("fitting")
        delays = range(config.delays + 1)
        found = fit(
            predict, trials, unknowns, delays, config.seed, lambda what: progress.update(task, description=what)
        )
    _show(console, found, spec, config.data)
    summary = {
        "data": config.data,
        "env": env.name,
        "physics": env.physics,
        "seed": config.seed,
        **_summary(found, spec),
    }
    write_atomically(config.path, json.dumps(summary, indent=2).encode())
    console.print(f"Figures: {config.path}", highlight=False, markup=False)


def _show(console: Console, found: Fit, spec: RobotSpec, data: str) -> None:
    table = Table(title=escape(f"{data}: what '{spec.name}' is like"), title_justify="left")
    table.add_column("parameter")
    for column in ("described", "found", "95 % interval"):
        table.add_column(column, justify="right")
    nominal = found.unknowns.values(np.zeros((1, len(found.unknowns))))[0]
    for number, label in enumerate(found.unknowns.labels):
        low, high = found.interval[:, number]
        cannot = "does not show" if found.unseen[number] else "cannot be told alone"
        known = f"{found.values[number]:.4g}", f"{low:.4g} to {high:.4g}"
        table.add_row(escape(label), f"{nominal[number]:.4g}", *(known if found.told[number] else ("", cannot)))
    table.add_row("actuator_delay", "0", f"{found.delay}", "steps")
    console.print(table)
    for direction in found.together:
        console.print(
            f"Nothing in these motions tells {_words(direction, found)} apart.", highlight=False, markup=False
        )
    errors = Table(title="Motions held out: root mean square errors of predicted positions, mrad", title_justify="left")
    for column in ("joint", "as described", "as found"):
        errors.add_column(column, justify="left" if column == "joint" else "right")
    for joint, before, after in zip(spec.joints, 1e3 * found.before, 1e3 * found.after, strict=True):
        errors.add_row(escape(joint), f"{before:.2f}", f"{after:.2f}")
    console.print(errors)
    says = "the noise of the sensors explains them" if found.explained else (
        "the model does not explain them: the robot has something that this engine or these parameters do not"
    )  # fmt: skip
    console.print(
        f"Errors are {found.ratio:.2f} times the noise ({1e3 * found.noise:.2f} mrad): {says}.", highlight=False
    )


def _words(direction: np.ndarray, found: Fit) -> str:
    share = np.abs(direction) / np.abs(direction).max()
    return " and ".join(label for label, each in zip(found.unknowns.labels, share, strict=True) if each > _SHOWN)


def _summary(found: Fit, spec: RobotSpec) -> dict[str, Any]:
    parameters = {
        label: {
            "value": float(found.values[number]),
            "interval": found.interval[:, number].tolist(),
            "told": bool(found.told[number]),
            "shows": not found.unseen[number],
        }
        for number, label in enumerate(found.unknowns.labels)
    }
    return {
        "parameters": parameters,
        "actuator_delay": found.delay,
        "cannot_be_told_apart": [_words(direction, found) for direction in found.together],
        "held_out": {
            joint: {"described": float(before), "found": float(after)}
            for joint, before, after in zip(spec.joints, found.before, found.after, strict=True)
        },
        "noise": found.noise,
        "ratio": found.ratio,
        "explained": found.explained,
    }


if __name__ == "__main__":
    cli.main("identify", _identify, _check)
