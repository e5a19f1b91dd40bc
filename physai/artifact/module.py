"""Everything between a robot's sensors and its velocity command as one scriptable TensorDictModule."""

import copy
import io
import warnings
import zipfile
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from physai.deploy.archive import METADATA
from physai.deploy.metadata import INPUTS, OUTPUT, input_keys, output_keys
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError

VIEWS = ("observation", "normalized_observation", "features")  # what a policy can see on a robot


class Deployable(TensorDictModuleBase):
    """Kinematics, observation, frozen normalization, network, squashing and scaling.

    It shares no memory with what it was made from, and needs no gradients.

    Args:
        observation: The task's observation module.
        normalizer: Normalizes an observation.
        network: Acts on what it sees, side by side.
        in_keys: What the network sees, of ``VIEWS``, in order.
        command_limit: What an action of 1 means, rad/s, [n].

    Raises:
        UserError: If the policy sees what no robot can tell it.
    """

    __jit_unused_properties__ = ("in_keys", "out_keys", "out_keys_source")  # of the base class; they do not script
    memory_size = 0

    def __init__(
        self,
        observation: nn.Module,
        normalizer: nn.Module,
        network: nn.Module,
        in_keys: list[str],
        command_limit: Tensor,
    ) -> None:
        super().__init__()
        for key in in_keys:
            if key not in VIEWS:
                raise UserError(
                    f"policy.actor.in_keys: a policy that sees '{key}' cannot be exported, for no robot can tell it; "
                    f"it can see {', '.join(VIEWS)}"
                )
        self.in_keys = list(INPUTS)
        self.out_keys = [OUTPUT]
        self.observation = copy.deepcopy(observation)
        self.normalizer = copy.deepcopy(normalizer)
        self.network = copy.deepcopy(network)
        self.seen = [VIEWS.index(key) for key in in_keys]
        self.command_limit: Tensor
        self.register_buffer("command_limit", command_limit.clone())
        self.requires_grad_(False)
        self.eval()

    def __call__(self, *inputs: Any) -> Any:
        """Act on tensors; or on a TensorDict with ``in_keys``, as other TensorDictModules do."""
        if len(inputs) != 1:
            return super().__call__(*inputs)
        (tensordict,) = inputs
        answer = super().__call__(*(tensordict.get(key) for key in self.in_keys))
        return tensordict.update(dict(zip(self.out_keys, as_tuple(answer), strict=True)))

    def views(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> list[Tensor]:
        """What the policy can see, in the order of ``VIEWS``: [N, 2n + 4], the same, and [N, features]."""
        observation, features = self.observation(joint_position, joint_velocity, goal)
        return [observation, self.normalizer(observation), features]

    @torch.jit.export
    def distance(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        """Distance of the end effector to the goal, m: [N, n] rad and [N, 2] m to [N, 1]."""
        distance: Tensor = self.observation.distance(joint_position, goal)  # type: ignore[operator]
        return distance


class DeployablePolicy(Deployable):
    """A policy whose ``network`` maps what it sees to actions in [-1, 1]."""

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        """Map positions [N, n] rad, velocities [N, n] rad/s and goals [N, 2] m to velocity commands [N, n], rad/s."""
        views = self.views(joint_position, joint_velocity, goal)
        return self.network(torch.cat([views[i] for i in self.seen], dim=1)) * self.command_limit


class RecurrentDeployablePolicy(Deployable):
    """A policy that remembers; its ``network`` maps what it sees and a memory to actions in [-1, 1] and the new memory.

    The memory is an input and an output: zeros where an episode begins, and the caller's to keep.

    Args:
        memory_size: H.
        parts: As of :class:`Deployable`.
    """

    def __init__(self, memory_size: int, *parts: Any) -> None:
        super().__init__(*parts)
        self.memory_size = memory_size
        self.in_keys, self.out_keys = list(input_keys(memory_size)), list(output_keys(memory_size))

    def forward(
        self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Map what the robot senses, as without memory, and a memory [N, H] to commands [N, n] and the new memory."""
        views = self.views(joint_position, joint_velocity, goal)
        action, new_memory = self.network(torch.cat([views[i] for i in self.seen], dim=1), memory)
        return action * self.command_limit, new_memory


def as_tuple(answer: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """What a policy gives: a command, or a command and a memory."""
    return answer if isinstance(answer, tuple) else (answer,)


def make_deployable(actor: TensorDictModuleBase, env: TransformedRobotEnv) -> Deployable:
    """Put a trained actor and the env that it was trained in together.

    Raises:
        UserError: If the policy sees what no robot can tell it.
    """
    joints = len(env.simulation.spec.joints)
    limit = torch.full((joints,), env.simulation.config.max_velocity)
    views = env.simulation.observation, env.normalization.normalizer
    size = getattr(actor, "memory_size", 0)
    if size:
        return RecurrentDeployablePolicy(size, *views, actor.deterministic(), actor.seen_keys, limit)
    return DeployablePolicy(*views, actor.deterministic(), actor.in_keys, limit)


def script(policy: Deployable) -> torch.jit.ScriptModule:
    """Compile to TorchScript.

    Raises:
        UserError: If a part of the policy is no TorchScript; it says what.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            return torch.jit.script(policy)
    except Exception as error:  # the compiler's errors have no base class of their own
        reason = " ".join(str(error).split())[:160]
        raise UserError(f"the policy cannot be exported: a part of it is no TorchScript ({reason})") from None


def save(scripted: torch.jit.ScriptModule, metadata: str | None = None) -> bytes:
    """The content of a policy file; metadata does not change how its code and weights are written.

    TorchScript's debug records are left out: they hold paths of the machine that trained.
    """
    written, target = io.BytesIO(), io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(scripted, written, _extra_files=None if metadata is None else {METADATA: metadata})
    with zipfile.ZipFile(written) as complete, zipfile.ZipFile(target, "w") as lean:
        for record in complete.infolist():
            if not record.filename.endswith(".debug_pkl"):
                lean.writestr(record, complete.read(record))
    return target.getvalue()
