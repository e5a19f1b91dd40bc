"""Policies of earlier runs that a run needs: one to go on with, or a teacher."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from physai.algorithms import Teacher
from physai.errors import UserError
from physai.policies import GaussianActor
from physai.training.config import TrainConfig
from physai.training.run import TrainedPolicy, load_config
from physai.transforms import RunningStatistics

_EXPLORING = ("initial_std", "exploration_std")  # arguments of actors that leave their networks as they are
_DYNAMICS = ("damping", "friction", "armature", "gravity", "inertials")  # what a policy may learn anew


def load_pretrained(config: TrainConfig, actor: TensorDictModuleBase, statistics: RunningStatistics) -> None:
    """Take weights, and statistics of observations, from the best policy of the run ``pretrained``.

    Args:
        config: The run that begins.
        actor: Its own.
        statistics: Those of its env; they go on from there.

    Raises:
        UserError: If there is no such policy, it is of another robot, control rate or task, or of another shape.
    """
    trained = _trained(config, config.pretrained, "pretrained", _DYNAMICS)
    own, theirs = config.policy.actor, trained.config.policy.actor
    keys = sorted(key for key in {*own, *theirs} - {*_EXPLORING} if own.get(key) != theirs.get(key))
    has = [f"policy.actor.{key}={theirs[key]}" if key in theirs else f"no policy.actor.{key}" for key in keys]
    if config.normalization != trained.config.normalization:
        has.append("another normalization")
    if has:
        raise UserError(f"pretrained: the policy of {config.pretrained} has {', '.join(has)}")
    try:
        trained.load_into(actor, statistics)
    except UserError as error:
        raise UserError(f"pretrained: {error}") from error


def load_teacher(config: TrainConfig) -> Teacher:
    """Read the best policy of the run that ``algo.teacher`` names.

    Args:
        config: The student's run.

    Raises:
        UserError: If there is no such policy, it is of another robot, control rate or task, or cannot say of a single
            state what it would do.
    """
    where = config.algo["teacher"]
    trained = _trained(config, where, "algo.teacher")
    actor, env = trained.deploy(1, seed=0)
    with closing(env):
        if not isinstance(actor, GaussianActor) or trained.config.memory_size:
            raise UserError(
                f"algo.teacher: the actor of {where} must be a GaussianActor without memory, such as that of "
                f"policy=privileged; it is a {type(actor).__name__}"
            )
        return Teacher(actor, env.normalizer)


def _trained(config: TrainConfig, where: object, key: str, free: Sequence[str] = ()) -> TrainedPolicy:
    """Read the best policy of the run that ``key`` names; it must know the task, and the robot but for what is free."""
    if not isinstance(where, str):
        raise UserError(f"{key}: a run folder is needed, got {where!r}")
    run_dir = Path(where)
    try:
        trained = TrainedPolicy(run_dir, "best", config=load_config(run_dir, config.allow))
    except UserError as error:
        raise UserError(f"{key}: {error}") from error
    own, theirs = config.env, trained.config.env
    robots = own.robot.model_dump(exclude={*free}), theirs.robot.model_dump(exclude={*free})
    names = [name for name, value in robots[0].items() if value != robots[1][name]]
    different = ["env.robot"] if "name" in names else [f"env.robot.{name}" for name in names]
    if own.control_dt != theirs.control_dt:
        different.append("env.control_dt")
    if own.task["_target_"] != theirs.task["_target_"]:
        different.append("env.task._target_")
    if different:
        raise UserError(
            f"{key}: {run_dir} knows '{theirs.name}', and '{own.name}' has another {' and '.join(different)}"
        )
    return trained
