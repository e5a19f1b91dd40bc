"""``python -m physai.capsules``: fit the capsules by which a robot's collisions are found (see ``--help``)."""

from pathlib import Path
from typing import Annotated

from omegaconf import DictConfig
from pydantic import Field

from physai import cli
from physai.compose import conf_dir
from physai.config import Config, Count, PositiveFloat, Seed, validate
from physai.errors import UserError
from physai.files import write_atomically
from physai.robots import RobotConfig, RobotSpec
from physai.robots.collision import CollisionConfig


class CapsulesConfig(Config):
    """``conf/capsules.yaml``."""

    robot: RobotConfig
    samples: Count
    near: PositiveFloat
    skin: Annotated[float, Field(ge=0)]
    false_alarms: Annotated[float, Field(ge=0, le=1)]
    most: Count
    seed: Seed
    output: str | None

    @property
    def path(self) -> Path:
        """Where the capsules are written."""
        return Path(self.output) if self.output else conf_dir() / "robot" / "collision" / f"{self.robot.name}.yaml"

    @property
    def picture(self) -> Path:
        """Where they are drawn."""
        return self.path.with_suffix(".png") if self.output else Path("outputs") / f"collision_{self.robot.name}.png"


def _check(node: DictConfig) -> None:
    if "robot" not in node:
        known = sorted(path.stem for path in (conf_dir() / "robot").glob("*.yaml"))
        raise UserError(f"say which robot, as in robot=panda; there are {', '.join(known)}")
    config = validate(CapsulesConfig, node)
    if config.path.suffix != ".yaml":
        raise UserError(f"output: '{config.output}' must end in .yaml")
    RobotSpec.from_config(config.robot).need_fixed_base("fitting capsules to")


def _fit(node: DictConfig, _: Path) -> None:
    from physai.physics.fit_capsules import CapsuleFit
    from physai.plots.capsules import plot_capsules

    config = validate(CapsulesConfig, node)
    spec = RobotSpec.from_config(config.robot)
    print(f"Looking at {config.samples} configurations of '{spec.name}' ...", flush=True)
    fit = CapsuleFit(spec, config.samples, config.near, config.skin, config.seed)
    found, judged, untold = fit.fit(config.false_alarms, config.most)
    write_atomically(config.path, as_yaml(found, spec.name).encode())
    fitted = RobotSpec.from_config(config.robot.model_copy(update={"collision": found}))
    config.picture.parent.mkdir(parents=True, exist_ok=True)
    plot_capsules(fitted, fit.parts, config.picture)
    print(
        f"{len(found.capsules)} capsules, {len(found.pairs)} pairs of them can meet.\n"
        f"Shapes touch in {judged.touching:.1%} of the configurations: capsules miss {judged.missed:.2%} of these, and "
        f"alarm falsely in {judged.false_alarms:.1%} of the others.\n"
        f"Written: {config.path}; drawn: {config.picture}"
    )
    for (first, second), touching in untold.items():
        print(
            f"Left out: {first} and {second}, whose capsules overlap nearly always. Their shapes touch in "
            f"{touching:.1%} of the configurations, which no capsules will tell"
        )
    if judged.false_alarms > config.false_alarms:
        print(f"More than the {config.false_alarms:.1%} false alarms of `false_alarms`: more capsules did not help")
    if config.robot.collision is None:
        print(f"To use them, add to the defaults of the robot's YAML: collision: {config.path.stem}")


def as_yaml(found: CollisionConfig, robot: str) -> str:
    """Write capsules as a file of ``conf/robot/collision``."""
    lines = [
        f"# Written by: python -m physai.capsules robot={robot}",
        "# Ends in the frames of the links, m; pairs are of places in the list of capsules, from 0 on.",
        "capsules:",
    ]
    for capsule in found.capsules:
        lines.append(
            f"  - {{link: {capsule.link}, start: {capsule.start}, end: {capsule.end}, radius: {capsule.radius}}}"
        )
    lines.append("pairs:" if found.pairs else "pairs: []")
    for pair in found.pairs:
        first, second = (found.capsules[place].link for place in pair)
        lines.append(f"  - {pair!s:<12}# {first}, {second}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    cli.main("capsules", _fit, _check)
