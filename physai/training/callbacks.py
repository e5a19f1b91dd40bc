"""What a run does beside learning: evaluate, log, save, show how far it is."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from physai.envs.make import TransformedRobotEnv
from physai.seeding import derive
from physai.training import checkpoint
from physai.training.agent import make_evaluation_env
from physai.training.config import TrainConfig
from physai.training.evaluation import MAX_ROBOTS, Evaluation, Recording, evaluate
from physai.training.logs import RunLog
from physai.training.progress import Progress
from physai.training.trainer import Callback, Trainer

Watch = Callable[[int, Recording], object]

EVALUATION_SEED = derive(0, "evaluation goals while training")  # the same goals for every run, unseen in training


class EvaluationCallback(Callback):
    """Evaluates the policy on the same goals every time, and keeps the best: by success and settled, then by return.

    The two rates count alike: among policies that reach nearly all goals, who reaches one more is chance.

    Its robots are made for the first evaluation: frames need not wait for them. A policy that was trained before is
    evaluated before the first frame, too: it may be the best.

    Args:
        config: The run's.
        watch: Gets some episodes of each evaluation, and how many frames the policy has learned from.

    Attributes:
        best_frames: How many frames the best policy has learned from.
    """

    name = "evaluation"

    def __init__(self, config: TrainConfig, watch: Watch | None = None) -> None:
        self._config = config
        self._watch = watch
        self._env: TransformedRobotEnv | None = None
        self._best = [-1.0, 0.0]
        self.best_frames = 0

    def begin(self, trainer: Trainer) -> None:
        """See :class:`Callback`."""
        if self._config.pretrained is not None and not trainer.clock.frames:
            rate = self._evaluate_and_keep(trainer).success_rate
            print(f"It begins with the policy of {self._config.pretrained}: success {rate:.1%}", flush=True)

    def after_batch(self, trainer: Trainer, batch: TensorDictBase, values: dict[str, float]) -> None:
        """Evaluate, when it is time."""
        if trainer.due(self._config.evaluation.every_frames, batch):
            with trainer.untimed():
                summary = self._evaluate_and_keep(trainer).summary().items()
            values |= {f"evaluation/{key}": value for key, value in summary if isinstance(value, float)}

    def _evaluate_and_keep(self, trainer: Trainer) -> Evaluation:
        result = self._evaluate(trainer)
        settled = 0.0 if result.mean_error else result.settled_rate  # where goals change, nobody stays at one
        score = [result.success_rate + settled, float(result.episode_return.mean())]
        if score >= self._best or not trainer.folder.best.is_file():
            self._best, self.best_frames = score, trainer.clock.frames
            content = {"frames": trainer.clock.frames, **trainer.agent.policy_state()}
            checkpoint.save(trainer.folder.best, content)
        return result

    def _evaluate(self, trainer: Trainer) -> Evaluation:
        goals = self._config.evaluation.goals
        if self._env is None:
            robots = min(goals, MAX_ROBOTS)
            randomization = self._config.evaluation.randomization
            self._env = make_evaluation_env(self._config, randomization, robots, EVALUATION_SEED)
        self._env.normalizer.load_state_dict(trainer.agent.statistics.normalizer.state_dict())
        watch = None if self._watch is None else partial(self._watch, trainer.clock.frames)
        return evaluate(trainer.agent.policy(), self._env, goals, EVALUATION_SEED, watch)

    def state(self) -> dict[str, Any]:
        """See :class:`Callback`."""
        return {"best": self._best, "best_frames": self.best_frames}

    def set_state(self, state: dict[str, Any]) -> None:
        """See :class:`Callback`."""
        self._best, self.best_frames = list(state["best"]), int(state["best_frames"])

    def close(self) -> None:
        """See :class:`Callback`."""
        if self._env is not None:
            self._env.close()


class LogCallback(Callback):
    """Writes episodes and metrics down.

    Args:
        run_dir: The run folder.
        make_logger: Returns a TorchRL logger.
    """

    name = "log"

    def __init__(self, run_dir: Path, make_logger: Callable[[], Any]) -> None:
        self._run_dir, self._make_logger = run_dir, make_logger
        self._log: RunLog | None = None
        self._state: dict[str, Any] | None = None

    def begin(self, trainer: Trainer) -> None:
        """See :class:`Callback`."""
        terms = trainer.agent.env.simulation.reward_terms
        self._log = RunLog(self._run_dir, terms, self._make_logger, self._state)

    def after_batch(self, trainer: Trainer, batch: TensorDictBase, values: dict[str, float]) -> None:
        """Write."""
        assert self._log is not None
        with trainer.untimed():
            self._log.open()  # its imports are no part of training
        clock = trainer.clock
        values |= self._log.episodes(batch, clock.frames - batch.numel()) | {"time/seconds": clock.seconds}
        self._log.metrics(clock.frames, clock.iteration, values)

    def state(self) -> dict[str, Any] | None:
        """See :class:`Callback`; brings everything to the disk."""
        return self._state if self._log is None else self._log.state()

    def set_state(self, state: dict[str, Any]) -> None:
        """See :class:`Callback`."""
        self._state = state

    def close(self) -> None:
        """See :class:`Callback`."""
        if self._log is not None:
            self._log.close()


class CheckpointCallback(Callback):
    """Saves the run, and once before its first frame: a kill from then on loses nothing.

    Args:
        every_frames: How often.
    """

    name = "checkpoint"

    def __init__(self, every_frames: int) -> None:
        self._every_frames = every_frames

    def begin(self, trainer: Trainer) -> None:
        """See :class:`Callback`."""
        if not trainer.clock.frames:
            trainer.save()

    def after_batch(self, trainer: Trainer, batch: TensorDictBase, values: dict[str, float]) -> None:
        """Save, when it is time."""
        if trainer.due(self._every_frames, batch):
            trainer.save()


class ProgressCallback(Callback):
    """Shows how far the run is."""

    name = "progress"

    def __init__(self) -> None:
        self._progress: Progress | None = None

    def begin(self, trainer: Trainer) -> None:
        """See :class:`Callback`."""
        self._progress = Progress(trainer.total_frames, trainer.clock.frames)
        self._progress.start()

    def after_batch(self, trainer: Trainer, batch: TensorDictBase, values: dict[str, float]) -> None:
        """Show it."""
        assert self._progress is not None
        clock = trainer.clock
        self._progress.update(clock.frames, clock.frames / clock.seconds, values)

    def close(self) -> None:
        """See :class:`Callback`."""
        if self._progress is not None:
            self._progress.stop()
