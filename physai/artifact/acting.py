"""A policy file in the place of an actor: it drives the simulated robots of a TorchRL env."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule
from torch import Tensor

from physai import foreign
from physai.artifact.module import as_tuple
from physai.config import validate
from physai.deploy import Policy, load_policy
from physai.deploy.metadata import LAST_COMMAND
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError
from physai.physics import RandomizationConfig
from physai.robots import JointCommand
from physai.training.agent import make_evaluation_env
from physai.training.config import TrainConfig


def as_actor(
    module: Callable[..., Any], in_keys: Sequence[str], out_keys: Sequence[str], joint_command: JointCommand
) -> TensorDictModule:
    """Wrap what maps what a robot senses to its command, and maybe to a memory: it writes ``action`` then.

    Args:
        module: Takes tensors [N, ...] of ``in_keys``, and gives one of each of ``out_keys``.
        in_keys: Names of its inputs.
        out_keys: Names of its outputs, the command first.
        joint_command: What turns actions into commands.
    """

    def act(*inputs: Tensor) -> tuple[Tensor, ...]:
        command, *memory = as_tuple(module(*inputs))
        given = dict(zip(in_keys, inputs, strict=True))
        return joint_command.action(command, given.get(LAST_COMMAND, command)), *memory

    return TensorDictModule(act, in_keys=list(in_keys), out_keys=["action", *out_keys[1:]])


class PolicyFile:
    """A policy file, and the simulated robots that it was trained for.

    Args:
        path: ``policy.pt``.
        randomization: How robots differ; None takes that of its evaluation in training.
        physics: Their engine; None takes that of its training.
        allow: Packages whose parts the config in it may name beside physai's, TorchRL's and torch's.

    Attributes:
        policy: Checked and loaded.
        config: Of the run that it comes from, with that engine.
        randomization: How robots differ.

    Raises:
        UserError: If the file or the config in it is damaged, or names what it may not (:mod:`physai.foreign`).
    """

    def __init__(
        self,
        path: Path,
        randomization: RandomizationConfig | None = None,
        physics: dict[str, Any] | None = None,
        allow: Sequence[str] = (),
    ) -> None:
        self.policy: Policy = load_policy(path)
        node = foreign.checked(dict(self.policy.metadata.raw["config"]), path, allow)
        try:
            config = validate(TrainConfig, DictConfig(node | {"allow": list(allow)}))
        except UserError as error:
            raise UserError(f"{path}: the config in it is damaged or from another version: {error}") from error
        if physics is not None:
            config = config.model_copy(update={"env": config.env.model_copy(update={"physics": physics})})
        self.config = config
        self.randomization = randomization or config.evaluation.randomization

    def deploy(
        self, num_envs: int, seed: int, randomization: RandomizationConfig | None = None
    ) -> tuple[TensorDictModule, TransformedRobotEnv]:
        """Build an actor, and so many robots; they differ as the file's do, if nothing else is given."""
        torch.set_num_threads(self.config.threads)
        env = make_evaluation_env(self.config, randomization or self.randomization, num_envs, seed)
        sides = (self.policy.metadata.inputs, self.policy.metadata.outputs)
        in_keys, out_keys = ([signal.name for signal in side] for side in sides)
        return as_actor(self.policy.module, in_keys, out_keys, env.simulation.joint_command), env
