"""The loop of a search: it asks for trials, has them run, prunes what looks worse than others, and tells the rest."""

from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from pathlib import Path

from optuna.trial import Trial

from physai.search import trials
from physai.search.config import SearchConfig
from physai.search.space import overrides
from physai.search.study import Study

_POLL = 0.5  # s between two looks at the evaluations of those that run
_PATIENCE = 20.0  # s for a run to save itself


def run_trials(
    folder: Path, study: Study, config: SearchConfig, fixed: Sequence[str], ended: Callable[[int], None]
) -> None:
    """Run the trials that are left; stop those that run if this is interrupted.

    Args:
        folder: Each trial runs in a folder there.
        study: What they belong to.
        config: What is common to all.
        fixed: The same as overrides.
        ended: Called with the number of each run that has come to its end.
    """
    settings = config.search
    running: list[_Running] = []
    try:
        while True:
            while len(running) < min(settings.jobs, settings.trials - study.done()):
                run, trial = study.ask()
                values = ["export.formats=[]", *fixed, *overrides(trial.params)]  # of many trials, few are for a robot
                step = study.trials()[run].last_step  # of a trial that goes on
                running.append(_Running(run, trial, -1 if step is None else step, folder / str(run), values, config))
            if not running:
                return
            wait([one.process.sentinel for one in running], _POLL)
            for one in list(running):
                over = not one.process.is_alive()  # before its last evaluations are read
                one.look()
                if over:
                    running.remove(one)
                    one.tell(study)
                    ended(one.run)
    finally:
        for one in running:
            one.process.terminate()
        for one in running:
            one.process.join(_PATIENCE)
            one.process.kill()


class _Running:
    """A trial that runs; its evaluations up to a ``step`` have been reported."""

    def __init__(
        self, run: int, trial: Trial, step: int, folder: Path, values: Sequence[str], config: SearchConfig
    ) -> None:
        self.run, self._trial, self._folder, self._settings = run, trial, folder, config.search
        self._every_frames = config.evaluation.every_frames
        self._step = step
        self._pruned = self._reached = False
        self.process = trials.start(folder, values)

    def look(self) -> None:
        """Report new evaluations, and stop the run if they are worse than the median of the others' at that step."""
        for one in trials.evaluations(self._folder):
            step = one.frames // self._every_frames
            self._reached |= self._settings.minimize and one.success_rate >= self._settings.target
            if step > self._step:
                self._step = step
                self._trial.report(-one.success_rate if self._settings.minimize else one.success_rate, step)
                if self._settings.prune and not (self._pruned or self._reached) and self._trial.should_prune():
                    self._pruned = True
                    self.process.terminate()

    def tell(self, study: Study) -> None:
        """Tell what came of it."""
        value = trials.success_rate(self._folder)
        if value is not None and self._settings.minimize:
            value = trials.time_to_target(self._folder, self._settings.target)
        error = None if value is not None or self._pruned else trials.error(self._folder, self.process.exitcode or 0)
        study.tell(self._trial, value, error)
