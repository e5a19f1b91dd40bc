"""Everything between a robot's sensors and its command as one scriptable TensorDictModule."""

import copy
import io
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from physai.deploy.archive import METADATA
from physai.deploy.metadata import ERROR, GOAL, LAST_COMMAND, MEMORY, NEW_MEMORY, POSITION
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError
from physai.signals import Quantity, Signal

VIEWS = ("observation", "normalized_observation", "features")  # what a policy can see on a robot
_ERROR = """
def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
    return self.observation.error(joint_position, goal)
"""


class Pipeline(nn.Module):
    """What all policies have between sensors and command; its subclasses have a method ``act``, which scripts.

    Kinematics, observation, frozen normalization, network and command. It shares no memory with what it was made from,
    and needs no gradients.

    Args:
        actor: The trained actor; its network makes actions of what it sees.
        env: The env that it was trained in.
        seen: What the network sees, as places in ``VIEWS``, in order.
        signature: Names of the inputs; pipelines of one type have the same.
    """

    __constants__ = ["signature"]  # noqa: RUF012  # which makes a type of its own of each

    def __init__(self, actor: Any, env: TransformedRobotEnv, seen: list[int], signature: str) -> None:
        super().__init__()
        self.observation = copy.deepcopy(env.simulation.task.module)
        self.normalizer = copy.deepcopy(env.normalizer)
        self.network = copy.deepcopy(actor.deterministic())
        self.command = copy.deepcopy(env.simulation.joint_command)
        self.seen = seen
        self.signature = signature
        self.requires_grad_(False)
        self.eval()

    @torch.jit.export
    def views(self, observation: Tensor, features: Tensor) -> list[Tensor]:
        """What the policy can see, in the order of ``VIEWS``, [N, ...] each."""
        return [observation, self.normalizer(observation), features]


class FeedForwardPipeline(Pipeline):
    """A pipeline whose ``network`` maps what it sees, side by side, to actions in [-1, 1]."""

    @torch.jit.export
    def act(self, observation: Tensor, features: Tensor, joint_position: Tensor, last_command: Tensor) -> Tensor:
        """Map what the task's module makes of a state, and the last command, [N, ...] each, to commands [N, n]."""
        views = self.views(observation, features)
        action = self.network(torch.cat([views[i] for i in self.seen], dim=1))
        return self.command(action, joint_position, last_command)


class RecurrentPipeline(Pipeline):
    """A pipeline that remembers; its ``network`` also takes a memory, and gives the new one.

    The memory is an input and an output: zeros where an episode begins, and the caller's to keep.
    """

    @torch.jit.export
    def act(
        self, observation: Tensor, features: Tensor, joint_position: Tensor, last_command: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Map the same as without memory, and a memory [N, H], to commands [N, n] and the new memory."""
        views = self.views(observation, features)
        action, new_memory = self.network(torch.cat([views[i] for i in self.seen], dim=1), memory)
        return self.command(action, joint_position, last_command), new_memory


class DeployablePolicy(TensorDictModuleBase):
    """A pipeline that takes and gives what its signals declare.

    Args:
        pipeline: What acts, a :class:`Pipeline`.
        inputs: Signals that it takes, in order.
        outputs: Signals that it gives, in order.

    Attributes:
        senses: Inputs that the task's module takes, in its order.
        measures: Whether the policy can tell how far its robot is from a goal.
        answer_keys: Names of all that it gives: its outputs, and the error where it ``measures`` that.
    """

    def __init__(self, pipeline: Any, inputs: Sequence[Signal], outputs: Sequence[Signal]) -> None:
        super().__init__()
        self.pipeline = pipeline
        self.eval()
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)
        self.in_keys, self.out_keys = [signal.name for signal in inputs], [signal.name for signal in outputs]
        self.memory_size = self.outputs[-1].size if self.out_keys[-1] == NEW_MEMORY else 0
        self.senses, self.measures = [*pipeline.observation.senses, GOAL], pipeline.observation.measures
        self.answer_keys = [*self.out_keys, *([ERROR] if self.measures else [])]

    def __call__(self, *inputs: Any) -> Any:
        """Act on tensors; or on a TensorDict with ``in_keys``, as other TensorDictModules do."""
        if len(inputs) != 1:
            return super().__call__(*inputs)
        (tensordict,) = inputs
        answer = super().__call__(*(tensordict.get(key) for key in self.in_keys))
        return tensordict.update(dict(zip(self.out_keys, as_tuple(answer), strict=True)))

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Map inputs to outputs, [N, ...] each."""
        given = dict(zip(self.in_keys, inputs, strict=True))
        seen = self.pipeline.observation(*(given[name] for name in self.senses))
        return self.pipeline.act(*seen, *(given[name] for name in self.arguments()))

    def views(self, given: Mapping[str, Tensor]) -> list[Tensor]:
        """What the policy can see of inputs by name, in the order of ``VIEWS``, [N, ...] each."""
        views: list[Tensor] = self.pipeline.views(*self.pipeline.observation(*(given[name] for name in self.senses)))
        return views

    def arguments(self) -> list[str]:
        """Inputs that what acts takes beside views; where the last command is none of them, it is not looked at."""
        last_command = LAST_COMMAND if LAST_COMMAND in self.in_keys else POSITION
        return [POSITION, last_command, *([MEMORY] if self.memory_size else [])]

    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        """How far the robot is from its goal: [N, n] rad and [N, g] to [N, e]."""
        error: Tensor = self.pipeline.observation.error(joint_position, goal)
        return error


def as_tuple(answer: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """What a policy gives: a command, or a command and a memory."""
    return answer if isinstance(answer, tuple) else (answer,)


def make_deployable(actor: TensorDictModuleBase, env: TransformedRobotEnv) -> DeployablePolicy:
    """Put a trained actor and the env that it was trained in together.

    Raises:
        UserError: If the policy sees what no robot can tell it.
    """
    simulation, memory_size = env.simulation, getattr(actor, "memory_size", 0)
    keys = actor.seen_keys if memory_size else actor.in_keys
    for key in keys:
        if key not in VIEWS:
            raise UserError(
                f"policy.actor.in_keys: a policy that sees '{key}' cannot be exported, for no robot can tell it; "
                f"it can see {', '.join(VIEWS)}"
            )
    inputs = simulation.sensed
    outputs: tuple[Signal, ...] = (simulation.spec.joint_command,)
    if memory_size:
        inputs += (Signal(MEMORY, Quantity.MEMORY, (memory_size,)),)
        outputs += (Signal(NEW_MEMORY, Quantity.MEMORY, (memory_size,)),)
    kind = RecurrentPipeline if memory_size else FeedForwardPipeline
    pipeline = kind(actor, env, [VIEWS.index(key) for key in keys], ", ".join(signal.name for signal in inputs))
    return DeployablePolicy(pipeline, inputs, outputs)


def script(policy: DeployablePolicy) -> torch.jit.ScriptModule:
    """Compile to TorchScript, with a ``forward`` that takes the policy's inputs by name, and maybe an ``error``.

    Raises:
        UserError: If a part of the policy is no TorchScript; it says what.
    """
    inputs = ", ".join(f"{name}: Tensor" for name in policy.in_keys)
    answer = "Tuple[Tensor, Tensor]" if policy.memory_size else "Tensor"
    see = f"observation, features = self.observation({', '.join(policy.senses)})"
    act = f"return self.act(observation, features, {', '.join(policy.arguments())})"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            scripted = torch.jit.script(policy.pipeline)
            if not hasattr(scripted, "forward"):  # of another policy of this type
                scripted.define(f"def forward(self, {inputs}) -> {answer}:\n    {see}\n    {act}\n")
                if policy.measures:
                    scripted.define(_ERROR)
            return scripted
    except Exception as error:  # the compiler's errors have no base class of their own
        reason = " ".join(str(error).split())[:160]
        raise UserError(f"the policy cannot be exported: a part of it is no TorchScript ({reason})") from error


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
