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
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from physai import cli
from physai.compose import cores
from physai.config import Config, Count, Seed, validate
from physai.envs.simulation import EnvConfig
from physai.errors import UserError
from physai.files import write_atomically
from physai.identify.fit import SPREAD, Fit, fit
from physai.identify.predictor import Predictor
from physai.identify.randomization import identified, text
from physai.identify.recording import read
from physai.identify.report import show, summary
from physai.identify.trials import Trials, cut
from physai.identify.unknowns import Unknowns
from physai.physics import ParameterLayout, RandomizationConfig
from physai.robots import RobotSpec


class IdentifyConfig(Config):
    """``conf/identify.yaml``."""

    data: str
    fit: Annotated[list[str], Field(min_length=1)]
    delays: Annotated[int, Field(ge=0, le=20)]
    output: str | None
    command_topic: str
    threads: Count | None
    seed: Seed
    env: dict[str, Any]
    physics: dict[str, Any]
    randomization: RandomizationConfig

    def robot(self) -> tuple[EnvConfig, RobotSpec, Unknowns]:
        """Return the env, its robot, and what is to be found; raises a UserError if there is none of these."""
        env = validate(EnvConfig, DictConfig(self.env))
        if not env.simulated:
            raise UserError("physics: only a simulated robot can be given other parameters")
        spec = RobotSpec.from_config(env.robot)
        spec.need_fixed_base("identifying")
        unknowns = Unknowns.of(self.fit, spec, ParameterLayout(spec))
        for name in self.fit:
            if name in env.ignored:
                raise UserError(f"fit: this engine cannot change '{name}': physics=mujoco can")
        return env, spec, unknowns

    def trials(self, env: EnvConfig, spec: RobotSpec) -> Trials:
        """Read the data."""
        return cut(read(Path(self.data), spec.joints, env.control_dt, self.command_topic), self.data, spec)

    @property
    def folder(self) -> Path:
        """Where the results go."""
        data = Path(self.data)
        return Path(self.output) if self.output else data.with_name(f"{data.stem}_identified")


def _check(node: DictConfig) -> None:
    config = validate(IdentifyConfig, node)
    if config.folder.exists() and not config.folder.is_dir():
        raise UserError(f"output: {config.folder} is no folder")
    env, spec, _ = config.robot()
    config.randomization.check(ParameterLayout(spec))
    trials = config.trials(env, spec)
    if "effort_limit" in config.fit and not np.isfinite(trials.measured[2]).any():
        raise UserError(
            f"fit: effort_limit does not show in {config.data}, which has no efforts: with twice the masses, damping, "
            "friction and effort a robot moves alike"
        )


def _identify(node: DictConfig, _: Path) -> None:
    config = validate(IdentifyConfig, node)
    env, spec, unknowns = config.robot()
    trials = config.trials(env, spec)
    # No result depends on the number of threads.
    threads = {"threads": config.threads or cores()} if "threads" in env.physics else {}
    console = Console(record=True)
    for reason in trials.left_out:
        console.print(f"left out: {reason}", highlight=False, markup=False)
    steps = int(np.isfinite(trials.measured[0]).all(axis=2).sum())
    console.print(
        f"{len(trials)} motions, {steps * trials.period:.0f} s; {len(unknowns)} unknowns, delays of 0 to "
        f"{config.delays} control steps"
    )
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with (
        Progress(*columns, transient=True, disable=not sys.stderr.isatty(), console=Console(stderr=True)) as progress,
        closing(Predictor(spec, env.physics | threads, env.control_dt, trials)) as predict,
    ):
        task = progress.add_task("fitting")
        found = fit(
            predict, trials, unknowns, config.delays, config.seed, lambda what: progress.update(task, description=what)
        )
    for number in found.spoilt:
        console.print(
            f"left out: at {trials.begins[number]:.2f} s: far from what other motions say; was something late?",
            highlight=False,
        )
    show(console, found, spec, config.data)
    if not found.explained and (hint := _untried(env, config.fit)):
        console.print(f"Not tried: {hint}.", highlight=False, markup=False, soft_wrap=True)
    _write(console, config, env, spec, found, trials.period)


def _untried(env: EnvConfig, names: list[str]) -> str:
    """What may explain more."""
    if env.physics.get("motor") != "servo":
        return "the motors of a drive (physics=mujoco physics.motor=servo)"
    return "" if "armature" in names else "the inertia of its rotors (armature among the parameters of fit=[...])"


def _write(
    console: Console, config: IdentifyConfig, env: EnvConfig, spec: RobotSpec, found: Fit, period: float
) -> None:
    """Write the figures, what to train with, the picture, and what was said."""
    from physai.plots.identify import Identification, plot_identification

    folder, layout = config.folder, ParameterLayout(spec)
    folder.mkdir(parents=True, exist_ok=True)
    figures = {"data": config.data, "env": env.name, "physics": env.physics, "seed": config.seed}
    write_atomically(folder / "identified.json", json.dumps(figures | summary(found, spec), indent=2).encode())
    motors = ""
    if env.physics.get("motor") == "servo":
        motors = f" physics=mujoco physics.motor=servo physics.motor_time_constant={env.physics['motor_time_constant']}"
    if spec.armature.any() and "armature" not in config.fit:
        motors += f" env.robot.armature=[{','.join(map(str, env.robot.armature))}]"
    about = (
        f"'{spec.name}' as {config.data} shows it, found by physai.identify; train with it:",
        f"python -m physai.train env={env.name}{motors} randomization={folder / 'identified.yaml'}",
    )
    draws = identified(found, layout, config.randomization)
    write_atomically(folder / "identified.yaml", text(draws, layout, about).encode())
    unknowns = found.unknowns
    title = f"'{spec.name}' from {config.data}: errors are {found.ratio:.2f} times the noise"
    shown = Identification(
        title, period, spec.joints, found.held_out, found.before, found.after, unknowns.labels, found.values,
        found.coordinates, SPREAD * found.deviation, found.told,
    )  # fmt: skip
    plot_identification(shown, folder / "identified.png")
    console.print(f"Picture: {folder / 'identified.png'}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"Train with it: {about[1]}", highlight=False, markup=False, soft_wrap=True)
    write_atomically(folder / "identified.txt", console.export_text().encode())


if __name__ == "__main__":
    cli.main("identify", _identify, _check)
