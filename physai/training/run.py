"""A whole run: train, evaluate the best policy on goals it has never seen, write it all down."""

import contextlib
import json
import subprocess
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from tensordict.nn import TensorDictModuleBase

from physai import foreign
from physai.config import validate
from physai.envs.make import TransformedRobotEnv
from physai.envs.simulation import EnvConfig
from physai.errors import UserError
from physai.files import write_atomically
from physai.physics import RandomizationConfig
from physai.seeding import derive
from physai.training import checkpoint
from physai.training.agent import Agent, load_policy_state, make_actor, make_evaluation_env, make_logger
from physai.training.callbacks import CheckpointCallback, EvaluationCallback, LogCallback, ProgressCallback, Watch
from physai.training.config import TrainConfig
from physai.training.curriculum import CurriculumCallback
from physai.training.evaluation import (
    MAX_ROBOTS,
    ROBOTS_IN_A_ROW,
    Evaluation,
    evaluate,
    evaluate_in_a_row,
    wilson,
)
from physai.training.stopping import end_stopped, stop_signals
from physai.training.trainer import Trainer
from physai.transforms import RunningStatistics

FINAL_SEED = derive(0, "final evaluation goals")


def load_config(
    run_dir: Path, allow: Sequence[str] = (), given: Sequence[str] = (), resume: bool = False
) -> TrainConfig:
    """Read the config of a run, which may be from elsewhere.

    Args:
        run_dir: The run folder.
        allow: Packages whose parts it may name beside physai's, TorchRL's and torch's.
        given: The user's overrides of ``conf/train.yaml``.
        resume: Whether the run will go on.

    Raises:
        UserError: If there is no run, its config is damaged, or it names what it may not (:mod:`physai.foreign`).
    """
    node = foreign.read_config(run_dir, allow, given, resume) | {"allow": list(allow)}
    try:
        return validate(TrainConfig, DictConfig(node))
    except UserError as error:
        path = run_dir / ".hydra" / "config.yaml"
        raise UserError(f"{path}: the run's config is damaged or from another version: {error}") from error


def run_training(
    config: TrainConfig,
    run_dir: Path,
    resume: bool = False,
    agent: Agent | None = None,
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Train in ``run_dir`` and write ``summary.json``; return the summary.

    Args:
        config: The run.
        run_dir: Where everything goes.
        resume: Whether to go on with an interrupted run.
        agent: Just built from ``config``, if it has been already; it is closed at the end.
        watch: See :class:`EvaluationCallback`.
    """
    done = run_dir / "summary.json"
    if resume and done.is_file():
        print(f"{run_dir} is complete already.")
        try:
            summary = json.loads(done.read_text())
            print_summary(summary, f"{run_dir}")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise UserError(f"{done}: the run's summary is damaged") from error
        return summary
    if agent is None:
        goes_on = resume and checkpoint.CheckpointFolder(run_dir / "checkpoints", config.checkpoint.keep).paths()
        agent = Agent.build(config.model_copy(update={"pretrained": None}) if goes_on else config)  # it lies there, too
    with contextlib.closing(agent), stop_signals() as stop:
        for doubt in agent.env.simulation.spec.doubtful:
            print(doubt)
        for name, why in config.randomization.without_effect(agent.env.simulation.layout).items():
            print(f"randomization.{name} has no effect: {why}")
        evaluation = EvaluationCallback(config, watch)
        trainer = make_trainer(config, run_dir, agent, evaluation, resume)
        trainer.fit(stop)
        if stop:
            end_stopped(stop[0], run_dir)
        print(f"Evaluating the best policy on {config.evaluation.episodes:,} goals it has never seen ...", flush=True)
        best = TrainedPolicy(run_dir, "best", config=config)
        result = best.evaluate(config.evaluation.episodes)
        figures = result.summary() | best.in_a_row(config.evaluation.in_a_row)
        summary = _summary(config, trainer, evaluation.best_frames, figures)
        write_atomically(done, json.dumps(summary, indent=2).encode())
    if stop:  # too late to matter for this run, but a sweep must end
        end_stopped(stop[0], run_dir)
    print_summary(summary, f"{config.env.name}: the best policy, on {len(result.success):,} goals it has never seen")
    print(f"Run folder: {run_dir}")
    return summary


def make_trainer(
    config: TrainConfig, run_dir: Path, agent: Agent, evaluation: EvaluationCallback, resume: bool = False
) -> Trainer:
    """Put a run together.

    Args:
        config: The run's.
        run_dir: Where checkpoints and logs go.
        agent: Built from ``config``.
        evaluation: Evaluates it while it trains.
        resume: Whether to go on from the last checkpoint, if there is one.

    Raises:
        UserError: If it cannot be resumed.
    """
    folder = checkpoint.CheckpointFolder(run_dir / "checkpoints", config.checkpoint.keep)
    ranges = agent.env.ranges
    curriculum = [] if config.curriculum is None or ranges is None else [CurriculumCallback(config.curriculum, ranges)]
    callbacks = [
        evaluation,
        *curriculum,  # before what it says is logged, and where it is saved
        LogCallback(run_dir, partial(make_logger, config, run_dir)),
        CheckpointCallback(config.checkpoint.every_frames),
        ProgressCallback(),
    ]
    trainer = Trainer(agent, config.total_frames, run_dir, folder, callbacks)
    if resume and folder.paths():
        trainer.restore()
    elif (run_dir / "metrics.csv").exists():
        raise UserError(f"{run_dir}: its checkpoints are gone; it cannot be resumed")
    return trainer


class TrainedPolicy:
    """A checkpoint of a run, to be evaluated or watched.

    Args:
        run_dir: The run folder.
        which: ``best``, ``last``, or a number of frames.
        randomization: How robots differ; None takes the run's own evaluation, or none for robots that are not
            simulated.
        env: What it drives; None takes the run's own.
        config: The run's, where it is known; None reads it from the run folder, and trusts it with nothing.

    Attributes:
        config: The run's, with that env.
        frames: How many the policy had been trained on.

    Raises:
        UserError: If there is no such run or checkpoint, it is damaged, or the env's robot has other joints.
    """

    def __init__(
        self,
        run_dir: Path,
        which: str,
        randomization: RandomizationConfig | None = None,
        env: EnvConfig | None = None,
        config: TrainConfig | None = None,
    ) -> None:
        self.config = config or load_config(run_dir)
        own = self.config.evaluation.randomization
        if env is not None:
            for what in ("joints", "command"):
                trained, given = getattr(self.config.env.robot, what), getattr(env.robot, what)
                if given != trained:
                    raise UserError(f"env '{env.name}' has the {what} {given}, the run's policy drives {trained}")
            self.config = self.config.model_copy(update={"env": env})
            own = own if env.simulated else RandomizationConfig.none()
        self.randomization = randomization or own
        self._state = checkpoint.load(checkpoint.CheckpointFolder(run_dir / "checkpoints", 1).find(which))
        self.frames = self._state.get("frames")
        if type(self.frames) is not int:
            raise UserError(f"{run_dir}: the checkpoint '{which}' does not say how many frames it has learned from")

    def deploy(
        self,
        num_envs: int,
        seed: int,
        env_config: EnvConfig | None = None,
        randomization: RandomizationConfig | None = None,
    ) -> tuple[TensorDictModuleBase, TransformedRobotEnv]:
        """Build the actor, and an env with the statistics that it was trained with; the run's, if no other is given."""
        config = self.config if env_config is None else self.config.model_copy(update={"env": env_config})
        torch.set_num_threads(config.threads)  # with more, threads wait for each other longer than they compute
        env = make_evaluation_env(config, randomization or self.randomization, num_envs, seed)
        try:
            actor = make_actor(config, env)
            self.load_into(actor, RunningStatistics(env.normalizer, eps=1.0))  # which no update asks for here
        except BaseException:
            env.close()
            raise
        return actor, env

    def load_into(self, actor: TensorDictModuleBase, statistics: RunningStatistics) -> None:
        """Give an actor its weights, and an env's normalization the statistics that it was trained with."""
        load_policy_state(actor, statistics, self._state)

    def evaluate(self, episodes: int, seed: int = FINAL_SEED) -> Evaluation:
        """Evaluate it on so many goals."""
        actor, env = self.deploy(min(episodes, MAX_ROBOTS) if self.config.env.simulated else 1, seed)
        try:
            return evaluate(actor, env, episodes, seed)
        finally:
            env.close()

    def in_a_row(self, goals: int, seed: int = FINAL_SEED) -> dict[str, Any]:
        """Evaluate it on so many goals one after the other.

        Returns:
            The figures; none of robots that are not simulated, or whose base floats: these get another goal in the
            midst of an episode.
        """
        if not goals or not self.config.env.simulated or self.config.env.robot.floating is not None:
            return {}
        start = self.config.env.start.model_copy(update={"carried_over": 1.0})
        carried = self.config.env.model_copy(update={"start": start})
        actor, env = self.deploy(ROBOTS_IN_A_ROW, seed, carried)
        try:
            success, near_limit = evaluate_in_a_row(actor, env, goals, seed)
        finally:
            env.close()
        rate = float(success.double().mean())
        joints = zip(carried.robot.joints, near_limit.tolist(), strict=True)
        return {
            "in_a_row": goals,
            "in_a_row_rate": rate,
            "in_a_row_ci": list(wilson(success)),
            "in_a_row_near_limit": dict(joints),
        }


def _summary(config: TrainConfig, trainer: Trainer, best_frames: int, figures: dict[str, Any]) -> dict[str, Any]:
    clock = trainer.clock
    return {
        "env": config.env.name,
        **figures,
        "randomization": config.evaluation.randomization.name,
        "frames": clock.frames,
        "best_frames": best_frames,
        "train_seconds": round(clock.seconds, 3),
        "frames_per_second": round(clock.frames / clock.seconds, 1),
        "weights_sha256": trainer.agent.weights_sha256(),
        "seed": config.seed,
        "git_commit": git_commit(),
    }


def git_commit() -> str | None:
    """The commit of physai's checkout, if it is one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def rate(summary: dict[str, Any], name: str) -> str:
    """A rate of a summary with its interval, for people."""
    low, high = summary[f"{name}_ci"]
    return f"{summary[f'{name}_rate']:.1%}   (95 % interval {low:.1%} to {high:.1%})"


def _mean_and_p99(summary: dict[str, Any], name: str) -> str:
    return f"{summary[f'{name}_mean']:.2g} (99 % are below {summary[f'{name}_p99']:.2g})"


def print_summary(summary: dict[str, Any], title: str) -> None:
    """Show the figures that matter as a table."""
    steps = summary["steps_to_goal"]
    names = {"success rate": "success", "settled": "settled", "crashed": "crashed"}
    rows = {shown: rate(summary, name) for shown, name in names.items()}
    if "in_a_row" in summary:
        rows[f"{summary['in_a_row']} in a row"] = rate(summary, "in_a_row")
        joint, share = max(summary["in_a_row_near_limit"].items(), key=lambda item: item[1])
        rows["near a limit"] = f"{share:.1%} of that time" + (f", {joint}" if share else "")
    for name, (value, unit) in summary.get("mean_error", {}).items():
        rows[f"mean error, {name}"] = f"{value:.3f} {unit}"
    rows |= {
        "steps to goal": "none reached" if steps is None else f"{steps:.1f}",
        "final distance": f"{summary['final_distance']:.3f} {summary['distance_unit']}",
        "return": f"{summary['return']:.2f}",
        "change of action": f"{_mean_and_p99(summary, 'action_change')} a step",
        "acceleration": f"{_mean_and_p99(summary, 'acceleration')} rad/s²",
        "randomization": summary["randomization"],
    }
    if "train_seconds" in summary:
        rows["training"] = (
            f"{summary['frames']:,} frames in {summary['train_seconds']:.1f} s ({summary['frames_per_second']:,.0f}/s)"
        )
    table = Table(title=title, show_header=False, title_justify="left")
    for row in rows.items():
        table.add_row(*row)
    Console().print(table)
