"""``python -m physai.evaluate``: judge the policy of a run (see ``--help``)."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from omegaconf import DictConfig
from pydantic import Field

from physai import cli
from physai.config import Config, Count, PackageName, Seed, validate
from physai.errors import UserError
from physai.files import write_atomically

if TYPE_CHECKING:
    from physai.envs.simulation import EnvConfig
    from physai.physics import RandomizationConfig
    from physai.training.run import TrainedPolicy


class PolicyChoice(Config):
    """Which policy of a run, and the robots that it drives."""

    allow: list[PackageName]
    checkpoint: str | int
    env: dict[str, Any] | None
    physics: dict[str, Any] | None
    randomization: dict[str, Any] | None

    def load(self, run: str) -> "TrainedPolicy":
        """Read it; raises a UserError if something is missing or damaged."""
        from physai.training.run import TrainedPolicy, load_config

        run_config = load_config(Path(run), self.allow)
        env = self._env(run_config.env)
        return TrainedPolicy(Path(run), str(self.checkpoint), self._randomization(), env, run_config)

    def _randomization(self) -> "RandomizationConfig | None":
        from physai.physics import RandomizationConfig

        if self.randomization is None:
            return None
        return validate(RandomizationConfig, DictConfig(self.randomization))

    def _env(self, run: "EnvConfig") -> "EnvConfig | None":
        """The robots, where they are not just the run's: in its engine, unless another is chosen or comes along."""
        from physai.envs.simulation import EnvConfig

        if self.env is None and self.physics is None:
            return None
        node = dict(self.env or run.model_dump() | {"physics": self.physics})
        if self.physics is not None and node.get("physics") != self.physics:
            raise UserError(f"physics: the robots of '{node.get('name')}' come with their own")
        if "physics" in node and node["physics"] is None:
            node["physics"] = run.physics
        return validate(EnvConfig, DictConfig(node))


class EvaluateConfig(PolicyChoice):
    """``conf/evaluate.yaml``."""

    run: str
    episodes: Count
    in_a_row: Annotated[int, Field(ge=0)]
    seed: Seed | None


def _check(node: DictConfig) -> None:
    config = validate(EvaluateConfig, node)
    config.load(config.run)


def _evaluate(node: DictConfig, _: Path) -> None:
    from physai.training.run import FINAL_SEED, print_summary

    config = validate(EvaluateConfig, node)
    policy = config.load(config.run)
    seed = FINAL_SEED if config.seed is None else config.seed
    figures = policy.evaluate(config.episodes, seed).summary() | policy.in_a_row(config.in_a_row, seed)
    summary = figures | {
        "env": policy.config.env.name,
        "physics": policy.config.env.physics,
        "randomization": policy.randomization.name,
        "checkpoint": config.checkpoint,
        "episodes": config.episodes,
        "seed": seed,
    }
    engine = policy.config.env.physics["_target_"].split(".")[-2]  # its module
    chosen = {policy.config.env.name: config.env, engine: config.physics}
    names = [*(name for name, choice in chosen.items() if choice is not None), policy.randomization.name]
    output = Path(config.run) / f"evaluation_{'_'.join(names)}.json"
    instead = ", in place of earlier figures of the same name" if output.exists() else ""
    write_atomically(output, json.dumps(summary, indent=2).encode())
    print_summary(summary, f"{config.run}: {config.checkpoint}, on {config.episodes:,} goals")
    print(f"Written to {output}{instead}")


if __name__ == "__main__":
    cli.main("evaluate", _evaluate, _check)
