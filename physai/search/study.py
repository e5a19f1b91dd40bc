"""The study: which values were tried, what came of them, and what is tried next.

Only this process writes to it; ``study.log`` is Optuna's journal, a line for each thing that happened. A trial is known
by its run, its number among those whose values were all drawn, and the name of its folder. One that runs when its
search is interrupted stays as it is in the journal, and goes on with the search.
"""

import contextlib
import fcntl
import os
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import BaseDistribution
from optuna.pruners import MedianPruner
from optuna.samplers import TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState

from physai.errors import UserError
from physai.search.space import Space
from physai.seeding import derive

_NAME = "study"
_FILE = "study.log"

optuna.logging.set_verbosity(optuna.logging.ERROR)


class Study:
    """The study of a folder; it goes on if there is one already.

    Args:
        folder: Where it is; it exists.
        about: What must not change while it goes on: plain values.
        space: What is searched.
        seed: What the values that are tried follow from, with what came of those before.
        minimize: Whether the best is the smallest.

    Raises:
        UserError: If the folder holds something else, its study is damaged, or another search is at work on it.
    """

    def __init__(self, folder: Path, about: dict[str, Any], space: Space, seed: int, minimize: bool) -> None:
        self.space, self.minimize = space, minimize
        self._seed = seed
        self._folder = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(self._folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path = folder / _FILE
            if not path.exists():
                _create(path, about, minimize)
            self._study = _load(path, about, space)
            _repair(path)
            self._interrupted = [run for run, one in self.trials().items() if one.state is TrialState.RUNNING]
        except BaseException as error:
            self.close()
            if isinstance(error, BlockingIOError):
                raise UserError(f"{folder}: another search is at work there") from error
            raise

    def close(self) -> None:
        """Let others work on it."""
        os.close(self._folder)

    def trials(self) -> dict[int, FrozenTrial]:
        """The trial of each run, by its number; one whose values were not all drawn, because of a kill, is none."""
        trials = self._study.get_trials(deepcopy=False)
        return dict(enumerate(trial for trial in trials if trial.params.keys() == self.space.keys()))

    def done(self) -> int:
        """How many runs have come to an end by themselves, or were pruned."""
        return sum(trial.state.is_finished() for trial in self.trials().values())

    def ask(self) -> tuple[int, Trial]:
        """Begin a trial, or go on with one that was interrupted; return the number of its run, and itself."""
        trials = self.trials()
        if self._interrupted:
            run = self._interrupted.pop(0)
            return run, Trial(self._study, trials[run]._trial_id)
        run = len(trials)
        # Its values follow from the run and what came before, however often the search was interrupted.
        self._study.sampler = TPESampler(seed=derive(self._seed, "search", run) % 2**32)
        return run, self._study.ask(self.space)

    def tell(self, trial: Trial, value: float | None = None, error: str | None = None) -> None:
        """End a trial: with its value, with the error that it failed with, or with neither, as pruned."""
        if error is not None:
            trial.set_user_attr("error", error)
            self._study.tell(trial, state=TrialState.FAIL)
        elif value is not None:
            self._study.tell(trial, value)
        else:
            self._study.tell(trial, state=TrialState.PRUNED)


def _create(path: Path, about: dict[str, Any], minimize: bool) -> None:
    """Make an empty study; the file is there only when it is whole."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.unlink(missing_ok=True)
    if others := [one.name for one in path.parent.iterdir() if not one.name.startswith(temporary.name)]:
        raise UserError(f"{path.parent} holds no study, but {min(others)}: choose another hydra.run.dir")
    direction = StudyDirection.MINIMIZE if minimize else StudyDirection.MAXIMIZE
    study = optuna.create_study(study_name=_NAME, storage=_storage(temporary), direction=direction)
    study.set_user_attr("about", about)
    os.replace(temporary, path)


def _storage(path: Path) -> JournalStorage:
    with contextlib.suppress(FileNotFoundError):  # of a search that was killed while it wrote
        path.with_name(f"{path.name}.lock").unlink()
    return JournalStorage(JournalFileBackend(str(path)))


def _load(path: Path, about: dict[str, Any], space: Space) -> optuna.Study:
    try:
        study = optuna.load_study(study_name=_NAME, storage=_storage(path), pruner=MedianPruner())
        trials, found = study.get_trials(), study.user_attrs.get("about")
    except Exception as error:  # whatever Optuna makes of a file of anyone's
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{path}: no study can be read there: {reason}") from error
    if found != about or not all(_is_ours(trial, space) for trial in trials):
        raise UserError(f"{path.parent} holds a study of something else: choose another hydra.run.dir")
    return study


def _is_ours(trial: FrozenTrial, space: Space) -> bool:
    """Whether a trial names nothing but what is searched, and was not enqueued: its values become overrides."""
    known: dict[str, BaseDistribution] = {key: space[key] for key in trial.distributions if key in space}
    return trial.distributions == known and "fixed_params" not in trial.system_attrs


def _repair(path: Path) -> None:
    """Cut off a last line that was not written to its end."""
    content = path.read_bytes()
    if not content.endswith(b"\n"):
        os.truncate(path, content.rfind(b"\n") + 1)
