"""A search for good values with Optuna: what it looks for, what it looks through, and going on after a kill.

Hydra's Optuna sweeper draws the trials and runs them; the study is ``study.db`` in the sweep's folder.
"""

import contextlib
import csv
import json
import math
import os
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig

from physai.errors import UserError

if TYPE_CHECKING:
    import optuna

    from physai.training.config import ObjectiveConfig

_NAME = "study"
_SWEEPER = "hydra_plugins.hydra_optuna_sweeper."


def objective(run: Path, settings: "ObjectiveConfig | DictConfig") -> float:
    """Return what a search makes best.

    Args:
        run: A finished run.
        settings: One file of ``conf/objective``.

    Returns:
        The success rate of the final evaluation; or, with a target, the seconds of training until an evaluation first
        had that success rate, infinity if none had.
    """
    if settings.target is None:
        summary = read_summary(run)
        return math.nan if summary is None else summary["success_rate"]
    with open(run / "metrics.csv", newline="") as file:
        for row in csv.DictReader(file):
            if row["evaluation/success_rate"] and float(row["evaluation/success_rate"]) >= settings.target:
                return float(row["time/seconds"])
    return math.inf


def read_summary(run: Path) -> dict[str, Any] | None:
    """Return the summary of a finished run."""
    path = run / "summary.json"
    return json.loads(path.read_text()) if path.is_file() else None


def searched(config: DictConfig, given: Sequence[str] = ()) -> list[str] | None:
    """Return what is searched: the ranges that come with the algorithm, and what the command line says.

    Args:
        config: With its ``hydra`` node.
        given: The command line's overrides.

    Returns:
        Overrides that are ranges; None if the sweep is no search.
    """
    if not config.hydra.sweeper._target_.startswith(_SWEEPER):
        return None
    ranges = {key: f"{key}={values}" for key, values in (config.hydra.sweeper.params or {}).items()}
    for override in OverridesParser.create().parse_overrides(list(given)):
        ranges.pop(override.get_key_element(), None)
        if override.is_sweep_override():
            ranges[override.get_key_element()] = str(override.input_line)
    return list(ranges.values())


def is_running() -> bool:
    """Whether this process runs a trial."""
    if not HydraConfig.initialized() or HydraConfig.get().mode is not RunMode.MULTIRUN:
        return False
    return HydraConfig.get().sweeper._target_.startswith(_SWEEPER)


def begin(folder: Path, config: DictConfig, ranges: Sequence[str], fixed: Sequence[str]) -> list[str]:
    """Make the study of a sweep, or make ready to go on with the one that is in its folder.

    Trials that were running when the study was killed are over: those whose run is complete get their value, the
    others are tried again, as new trials.

    Args:
        folder: The sweep's.
        config: Without what is swept over, with its ``hydra`` node.
        ranges: From ``searched``.
        fixed: Overrides of all trials.

    Returns:
        Overrides for Hydra: how many trials are left, and which folder and seed is that of the next.

    Raises:
        UserError: If the folder's study is about something else, or its file is damaged.
    """
    import optuna
    from optuna.trial import TrialState

    os.environ["HYDRA_FULL_ERROR"] = "1"  # for without_result
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    settings, direction = config.hydra.sweeper, config.objective.direction
    fixed = sorted(one for one in fixed if not one.startswith(("hydra", "allow=")))
    about = {"fixed": fixed, "ranges": sorted(ranges), "direction": direction}
    storage = f"sqlite:///{folder}/study.db"
    try:
        study = optuna.create_study(study_name=_NAME, storage=storage, direction=direction, load_if_exists=True)
        trials, found = study.trials, study.user_attrs.get("about", about)
    except Exception as error:  # whatever SQLite and Optuna make of a file of anyone's
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{folder}/study.db: no study can be read there: {reason}") from None
    keys = {one.partition("=")[0] for one in ranges}
    if found != about or any(not keys.issuperset(trial.params) for trial in trials):
        raise UserError(f"{folder} holds a study of something else: choose another hydra.sweep.dir")
    if "cmaes" not in config.allow and any(":optimizer" in key for trial in trials for key in trial.system_attrs):
        raise UserError(f"{folder}/study.db holds a pickle of CMA-ES, which may run anything; yours? allow=[cmaes]")
    study.set_user_attr("about", about)
    over = [trial for trial in trials if trial.state is not TrialState.WAITING]
    for trial in over:
        if trial.state is TrialState.RUNNING:
            run = folder / str(trial.number)
            value = objective(run, config.objective) if (run / "summary.json").is_file() else math.nan
            if math.isnan(value):
                study.tell(trial.number, state=TrialState.FAIL)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                    study.enqueue_trial(trial.params)
            else:
                study.tell(trial.number, value)
    begun = len(over)
    done = sum(trial.state is TrialState.COMPLETE or failed(folder, trial) for trial in study.trials)
    left = max(0, settings.n_trials - done)
    pinned = [f"hydra.sweeper.n_trials={left}", f"hydra.sweep.subdir='${{add:${{hydra.job.num}},{begun}}}'"]
    if "seed" in settings.sampler and settings.sampler.seed is None:
        pinned.append(f"hydra.sweeper.sampler.seed={config.seed + begun}")
    if begun:
        print(f"{folder}: {done} trials are done, {left} are left.")
    return pinned


@contextlib.contextmanager
def without_result() -> Iterator[None]:
    """Context in which a study that has no best trial ends in one line; Hydra's sweeper asks for it all the same."""
    try:
        yield
    except ValueError as error:
        if str(error) != "Record does not exist.":  # from Optuna's storage
            raise
        print("error: none of the trials came to an end; the error.txt of each says why", file=sys.stderr)
        sys.exit(1)


def load(folder: Path) -> "optuna.Study":
    """Return the study of a sweep."""
    import optuna

    return optuna.load_study(study_name=_NAME, storage=f"sqlite:///{folder}/study.db")


def failed(folder: Path, trial: "optuna.trial.FrozenTrial") -> bool:
    """Whether a trial ended without a value, by itself: not killed."""
    return trial.state.name == "FAIL" and (folder / str(trial.number) / "error.txt").is_file()


def short_names(keys: Iterable[str]) -> dict[str, str]:
    """The last word of each key, or all of it where two have the same."""
    keys = sorted(set(keys))
    last = [key.rpartition(".")[2] for key in keys]
    return {key: name if last.count(name) == 1 else key for key, name in zip(keys, last, strict=True)}


def objective_name(study: "optuna.Study") -> str:
    """What the values of the trials are."""
    return "success rate" if study.direction.name == "MAXIMIZE" else "seconds to target"


def command(study: "optuna.Study", trial: "optuna.trial.FrozenTrial") -> list[str]:
    """The overrides that make a run of a trial."""
    return [*study.user_attrs["about"]["fixed"], *(f"{key}={value}" for key, value in trial.params.items())]


def write_csv(study: "optuna.Study", path: Path) -> None:
    """Write a row for each trial: its folder, what became of it, its value and parameters."""
    keys = sorted({key for trial in study.trials for key in trial.params})
    with open(path, "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["run", "state", objective_name(study), *keys])
        for trial in study.trials:
            value = "" if trial.value is None else trial.value
            rows.writerow([trial.number, trial.state.name.lower(), value, *(trial.params.get(key, "") for key in keys)])
