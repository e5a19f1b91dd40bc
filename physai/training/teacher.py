"""The teacher of a distillation, from its run folder."""

from contextlib import closing
from pathlib import Path

from physai.algorithms import Teacher
from physai.errors import UserError
from physai.policies import GaussianActor
from physai.training.config import TrainConfig
from physai.training.run import TrainedPolicy, load_config

_SAME = ("robot", "control_dt")


def load_teacher(config: TrainConfig) -> Teacher:
    """Read the best policy of the run that ``algo.teacher`` names.

    Args:
        config: The student's run.

    Raises:
        UserError: If there is no such policy, it is of another robot, control rate or task, or cannot say of a single
            state what it would do.
    """
    where = config.algo["teacher"]
    if not isinstance(where, str):
        raise UserError(f"algo.teacher: the run folder of a teacher is needed, got {where!r}")
    run_dir = Path(where)
    try:
        trained = TrainedPolicy(run_dir, "best", config=load_config(run_dir, config.allow))
    except UserError as error:
        raise UserError(f"algo.teacher: {error}") from error
    own, theirs = config.env, trained.config.env
    different = [f"env.{name}" for name in _SAME if getattr(own, name) != getattr(theirs, name)]
    if own.task["_target_"] != theirs.task["_target_"]:
        different.append("env.task._target_")
    if different:
        raise UserError(
            f"algo.teacher: {run_dir} knows '{theirs.name}', and '{own.name}' has another {' and '.join(different)}"
        )
    actor, env = trained.deploy(1, seed=0)
    with closing(env):
        if not isinstance(actor, GaussianActor) or trained.config.memory_size:
            raise UserError(
                f"algo.teacher: the actor of {run_dir} must be a GaussianActor without memory, such as that of "
                f"policy=privileged; it is a {type(actor).__name__}"
            )
        return Teacher(actor, env.normalizer)
