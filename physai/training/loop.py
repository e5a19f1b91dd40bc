"""The training loop."""

import contextlib
import os
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase

from physai.algorithms import NonFiniteError
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError
from physai.seeding import derive
from physai.training import checkpoint
from physai.training.agent import Agent, make_evaluation_env, make_logger
from physai.training.config import TrainConfig
from physai.training.evaluation import MAX_ROBOTS, Evaluation, evaluate
from physai.training.logs import RunLog
from physai.training.progress import Progress

EVALUATION_SEED = derive(0, "evaluation goals while training")  # the same goals for every run, unseen in training


@dataclass
class Clock:
    """How far a run is: what its loop counts, and the time that took."""

    frames: int = 0
    iteration: int = 0
    seconds: float = 0.0
    best: list[float] = field(default_factory=lambda: [-1.0, 0.0])
    best_frames: int = 0


class Interrupted(Exception):  # noqa: N818
    """A signal asked the run to stop; everything is saved."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal.Signals(signal_number).name)
        self.exit_code = 128 + signal_number


def train(
    config: TrainConfig, run_dir: Path, resume: bool, stop: Sequence[int] = (), agent: Agent | None = None
) -> tuple[Agent, Clock]:
    """Train until ``total_frames``, or go on from the last checkpoint in ``run_dir``.

    Args:
        config: The run.
        run_dir: Where checkpoints and logs go.
        resume: Whether to go on.
        stop: From ``stop_signals``; when it fills, the iteration is finished and saved.
        agent: Just built from ``config``, if it has been already.

    Returns:
        The trained agent, to be closed by the caller, and the clock at the end.

    Raises:
        Interrupted: After SIGINT or SIGTERM, when the iteration is done and saved.
        UserError: If the disk is full or a number is not finite; the last good checkpoint is kept.
    """
    agent = agent or Agent.build(config)
    folder = checkpoint.CheckpointFolder(run_dir / "checkpoints", config.checkpoint.keep)
    clock, logged = Clock(), None
    try:
        if resume and folder.paths():
            clock, logged = _restore(agent, checkpoint.load(folder.find("last")))
        elif (run_dir / "metrics.csv").exists():
            raise UserError(f"{run_dir}: its checkpoints are gone; it cannot be resumed")
        _run(config, run_dir, agent, clock, logged, folder, stop)
    except BaseException:
        agent.close()
        raise
    return agent, clock


def _run(
    config: TrainConfig,
    run_dir: Path,
    agent: Agent,
    clock: Clock,
    logged: dict[str, Any] | None,
    folder: checkpoint.CheckpointFolder,
    stop: Sequence[int],
) -> None:
    judge = _Judge(config)
    log = RunLog(run_dir, agent.env.simulation.reward_terms, partial(make_logger, config, run_dir), logged)
    progress = Progress(config.total_frames, clock.frames)
    try:
        if not clock.frames:
            _save(agent, clock, log, folder)  # a kill from here on loses nothing
        with progress:
            _loop(config, agent, judge, clock, log, folder, progress, stop)
        if stop:
            _save(agent, clock, log, folder)
            raise Interrupted(stop[0])
    except NonFiniteError as error:
        raise UserError(_keep_evidence(error, clock, run_dir, folder)) from error
    except OSError as error:
        kept = folder.paths()[-1] if folder.paths() else "none yet"
        raise UserError(
            f"cannot write to {run_dir}: {error.strerror or error}; last good checkpoint: {kept}"
        ) from error
    finally:
        judge.close()
        with contextlib.suppress(OSError):  # a full disk refuses the last rows, too
            log.close()


def _loop(
    config: TrainConfig,
    agent: Agent,
    judge: "_Judge",
    clock: Clock,
    log: RunLog,
    folder: checkpoint.CheckpointFolder,
    progress: Progress,
    stop: Sequence[int],
) -> None:
    batches = iter(agent.collector)
    while clock.frames < config.total_frames and not stop:
        started = time.perf_counter()
        batch = next(batches)
        collected = time.perf_counter()
        first_frame, clock.frames, clock.iteration = (
            clock.frames,
            clock.frames + batch.numel(),
            clock.iteration + 1,
        )
        _check_finite(batch)
        agent.env.normalization.update(batch.get("observation"))
        values = log.episodes(batch, first_frame) | agent.algorithm.update(batch)
        updated = time.perf_counter()
        clock.seconds += updated - started
        values |= {
            "time/collect": collected - started,
            "time/update": updated - collected,
            "time/frames_per_second": batch.numel() / (updated - started),
            "time/seconds": clock.seconds,
        }
        done = clock.frames >= config.total_frames
        if done or _due(first_frame, clock.frames, config.evaluation.every_frames):
            result = _evaluate(agent, judge, clock, folder)
            values |= {f"evaluation/{key}": value for key, value in result.items() if isinstance(value, float)}
        log.open()  # its imports are no part of training
        saving = time.perf_counter()
        log.metrics(clock.frames, clock.iteration, values)
        if done or _due(first_frame, clock.frames, config.checkpoint.every_frames):
            _save(agent, clock, log, folder)
        clock.seconds += time.perf_counter() - saving
        progress.update(clock.frames, clock.frames / clock.seconds, values)


class _Judge:
    """Judges a policy on the same goals every time; its robots are built when it first does: frames need not wait."""

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._env: TransformedRobotEnv | None = None

    def __call__(self, agent: Agent) -> Evaluation:
        settings = self._config.evaluation
        if self._env is None:
            robots = min(settings.goals, MAX_ROBOTS)
            self._env = make_evaluation_env(self._config, settings.randomization, robots, EVALUATION_SEED)
        self._env.normalization.load_state_dict(agent.env.normalization.state_dict())
        return evaluate(agent.policy(), self._env, settings.goals, EVALUATION_SEED)

    def close(self) -> None:
        if self._env is not None:
            self._env.close()


def _due(before: int, after: int, every: int) -> bool:
    return before // every != after // every


def _check_finite(batch: TensorDictBase) -> None:
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        if not torch.isfinite(batch.get(key)).all():
            raise NonFiniteError(f"'{key if isinstance(key, str) else '.'.join(key)}' from the simulation", batch)


def _evaluate(
    agent: Agent,
    judge: "_Judge",
    clock: Clock,
    folder: checkpoint.CheckpointFolder,
) -> dict[str, Any]:
    """Judge the policy, and keep it if it is the best so far: by success rate, then by return."""
    result = judge(agent)
    summary = result.summary()
    score = [result.success_rate, float(result.episode_return.mean())]
    if score >= clock.best or not folder.best.is_file():
        clock.best, clock.best_frames = score, clock.frames
        checkpoint.save(folder.best, {"frames": clock.frames, **agent.policy_state()})
    return summary


def _save(agent: Agent, clock: Clock, log: RunLog, folder: checkpoint.CheckpointFolder) -> None:
    content = {
        **agent.policy_state(),
        "frames": clock.frames,
        "clock": vars(clock).copy(),
        "algorithm": agent.algorithm.state(),
        "collector": agent.collector.state(),
        "random": torch.get_rng_state(),
        "random_on_gpus": torch.cuda.get_rng_state_all() if agent.on_gpu else [],
        "log": log.state(),
    }
    folder.save(clock.frames, content)


def _restore(agent: Agent, content: dict[str, Any]) -> tuple[Clock, dict[str, Any]]:
    try:
        agent.algorithm.set_state(content["algorithm"])
        agent.collector.set_state(content["collector"])
        agent.env.normalization.load_state_dict(content["normalization"])  # robots in other processes bring none along
        torch.set_rng_state(content["random"])
        torch.cuda.set_rng_state_all(content["random_on_gpus"])
        return Clock(**content["clock"]), content["log"]
    except (RuntimeError, LookupError, TypeError, ValueError, AttributeError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0][:120]
        raise UserError(f"the checkpoint does not fit the run's config: {reason}") from None


def _keep_evidence(error: NonFiniteError, clock: Clock, run_dir: Path, folder: checkpoint.CheckpointFolder) -> str:
    evidence = run_dir / "not_finite.pt"
    checkpoint.save(evidence, {"batch": error.batch.to_dict(), "frames": clock.frames})
    kept = folder.paths()[-1] if folder.paths() else "none yet"
    return (
        f"iteration {clock.iteration}: {error} is not finite; the batch is in {evidence}, "
        f"the last good checkpoint is {kept}"
    )


@contextlib.contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM instead of dying by them; a second one is obeyed at once."""
    received: list[int] = []

    def remember(number: int, frame: FrameType | None) -> None:
        if received:
            os._exit(128 + number)
        received.append(number)

    before = {number: signal.signal(number, remember) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
