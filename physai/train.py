"""``python -m physai.train``: train a policy (see ``--help``)."""

import contextlib
import gc
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from physai import cli
from physai.config import not_installed
from physai.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from physai.training.agent import Agent
    from physai.training.callbacks import Watch
    from physai.training.config import TrainConfig, WatchConfig


def main() -> None:
    """Start a run, a sweep, or an interrupted run again."""
    given = cli.overrides()
    resumed = [override.partition("=")[2] for override in given if override.startswith("resume=")]
    if resumed and resumed[-1] not in ("", "null"):
        others = [override for override in given if not override.startswith("resume=")]
        with cli.guard():
            _resume(Path(resumed[-1].strip("'\"")), others)
    else:
        with contextlib.closing(Training(keep=not _sweeps())) as training:
            cli.main("train", training.train, training.check)


def _sweeps() -> bool:
    return not {"-m", "--multirun"}.isdisjoint(sys.argv)


def _config(node: DictConfig) -> "TrainConfig":
    from physai.config import validate
    from physai.training.config import TrainConfig

    return validate(TrainConfig, node)


def _watching(node: DictConfig) -> "WatchConfig":
    from physai.config import validate
    from physai.training.config import WatchConfig

    shown = validate(WatchConfig, OmegaConf.masked_copy(node, list(WatchConfig.model_fields)))
    if shown.render == "web" and importlib.util.find_spec("viser") is None:
        raise UserError(f"render=web needs {not_installed('viser')}")
    return shown


# What processes that collect are made of.
_COLLECTING = (
    *("collector", "env", "physics", "randomization", "curriculum", "normalization"),
    *("policy", "device", "threads", "allow"),
)


class Training:
    """Builds every part of a run, so that whatever is wrong shows before a run folder exists; then trains with them.

    Args:
        keep: What was checked is what will be trained; the jobs of a sweep build their own parts, maybe elsewhere.
    """

    def __init__(self, keep: bool = False) -> None:
        self._keep = keep
        self._agent: Agent | None = None
        self._checked: set[str] = set()

    def check(self, node: DictConfig) -> None:
        """Build the parts; raises a UserError if one cannot be built. In a sweep, what was built once is not again."""
        from physai.artifact.module import make_deployable, script
        from physai.artifact.transfer import other_engine
        from physai.training.agent import Agent

        self.close()
        if self._checked:
            gc.collect()
        config = _config(node)
        _watching(node)
        apart_from_seed = repr(config.model_copy(update={"seed": 0}))
        collecting = repr([getattr(config, name) for name in _COLLECTING])
        if apart_from_seed in self._checked:
            return
        if collecting in self._checked:
            config = config.model_copy(update={"collector": config.collector.smallest})
        self._agent = Agent.build(config)
        if config.export.formats:
            script(make_deployable(self._agent.policy(), self._agent.env))  # what does not script cannot be exported
            if config.export.transfer == "require":
                other_engine(config.env.physics)
        if not self._keep:
            self.close()
            if not self._checked:
                gc.freeze()  # what was imported: to look at it again takes a quarter of a second for each config
            self._checked |= {apart_from_seed, collecting}

    def __reduce__(self) -> tuple[type, tuple[()]]:
        return Training, ()  # a job in another process builds its own

    def train(self, node: DictConfig, run_dir: Path) -> None:
        """Train, and export the best policy."""
        from physai.training.run import run_training

        agent, self._agent = self._agent, None
        config, shown = _config(node), _watching(node)
        with _drawn_and_exported(config, run_dir), _page(config, shown) as watch:
            run_training(config, run_dir, agent=agent, watch=watch)

    def close(self) -> None:
        """Free what ``train`` did not take."""
        if self._agent is not None:
            self._agent.close()
            self._agent = None
            gc.collect()  # its parts know each other, and the next config's are as many


def _resume(run_dir: Path, given: list[str]) -> None:
    from physai import foreign
    from physai.compose import compose
    from physai.training.run import load_config, run_training

    if _sweeps():
        raise UserError("resume continues one run; it cannot be swept over")
    allow = [name for override in given if override.startswith("allow=") for name in _allowed(override)]
    others = [override for override in given if not override.startswith("allow=")]
    config = load_config(run_dir, allow, others, resume=True)
    if others:
        path = run_dir / ".hydra" / "overrides.yaml"
        node = compose("train", [*foreign.read_overrides(run_dir), *others])
        checked = foreign.checked(OmegaConf.to_container(node), path, allow, others, resume=True)
        wanted = _config(OmegaConf.create(checked | {"allow": allow}))
        run, asked = (dict(foreign.walk(one.model_dump())) for one in (config, wanted))
        for key in {**run, **asked}:
            old, new = run.get(key), asked.get(key)
            if old != new and not (isinstance(old, dict) and isinstance(new, dict)):  # then a key in them differs, too
                difference = f"{'.'.join(map(str, key))}={old}, not {new}"
                raise UserError(f"resume={run_dir}: the run has {difference}; a resumed run keeps its config")
    shown = [override for override in given if override.split("=")[0].split(".")[0] in ("render", "web")]
    watching = _watching(compose("train", shown))
    with _drawn_and_exported(config, run_dir), _page(config, watching) as watch:
        run_training(config, run_dir, resume=True, watch=watch)


def _allowed(override: str) -> list[str]:
    """Packages in ``allow=[...]``."""
    from physai.compose import compose
    from physai.config import Config, PackageName, validate

    class Allowed(Config):
        allow: list[PackageName]

    return validate(Allowed, OmegaConf.masked_copy(compose("train", [override]), ["allow"])).allow


@contextlib.contextmanager
def _drawn_and_exported(config: "TrainConfig", run_dir: Path) -> "Iterator[None]":
    """Context of a training; then the run is drawn, and its policy exported."""
    complete = (run_dir / "summary.json").is_file()
    yield
    if not (complete and (run_dir / "training.png").is_file()):
        _draw(config, run_dir)
    _export(config, run_dir, complete)


@contextlib.contextmanager
def _page(config: "TrainConfig", shown: "WatchConfig") -> "Iterator[Watch | None]":
    """Context in which a page shows what is handed to it, if one is asked for."""
    if shown.render is None:
        yield None
        return
    from physai.web.training import TrainingPage

    with contextlib.closing(TrainingPage(config.env, shown.web.host, shown.web.port)) as page:
        print(f"The page: {page.address}", flush=True)
        yield page.show


def _draw(config: "TrainConfig", run_dir: Path) -> None:
    from physai.plots.curriculum import plot_curriculum  # no frame needs to wait for Matplotlib
    from physai.plots.runs import plot_runs

    try:
        plot_runs([run_dir], run_dir / "training.png")
    except UserError as error:
        print(f"No training.png: {error}")
    if config.curriculum is not None:
        plot_curriculum(run_dir, config.randomization, run_dir / "curriculum.png")


def _export(config: "TrainConfig", run_dir: Path, complete: bool) -> None:
    """Export the best policy, unless a run that was complete before has its files."""
    from physai.artifact import FILES, onnx
    from physai.export import export

    lacking = onnx.missing() if "onnx" in config.export.formats else []
    formats = [name for name in config.export.formats if not (name == "onnx" and lacking)]
    files = [FILES[name] for name in formats]
    if "torchscript" in formats:
        files.append(f"{FILES['torchscript']}.sha256")
    if complete and all((run_dir / name).exists() for name in files):
        return
    if formats:
        export(run_dir, "best", formats, config)
    if lacking:
        print(f"No {FILES['onnx']}: it needs {', '.join(lacking)} (pip install 'physai[onnx]')")


if __name__ == "__main__":
    from physai import train  # what another process unpickles has a home

    train.main()
