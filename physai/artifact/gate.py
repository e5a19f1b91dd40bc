"""The gate: every form of an exported policy must agree with the policy that was trained."""

import copy
import hashlib
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.artifact import fresh_process
from physai.artifact.module import VIEWS, Deployable, as_tuple
from physai.artifact.states import States
from physai.deploy.metadata import DISTANCE, NEW_MEMORY, OUTPUT, Metadata, input_keys, output_keys
from physai.deploy.policy import load_module
from physai.envs.make import TransformedRobotEnv
from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.training.evaluation import Evaluation, evaluate
from physai.transforms import Observation, ObservationNormalization

BATCH_TOLERANCE = 1e-5  # rad/s; a row of a batch is rounded otherwise than the same row alone
ONNX_TOLERANCE = 1e-5  # rad/s
SUCCESS_TOLERANCE = 0.01
PATIENCE = 120  # s

Function = Callable[..., Tensor | tuple[Tensor, ...]]
"""A policy: its inputs, [N, ...] each, to a command [N, n], or to a command and a new memory [N, H]."""


class GateError(UserError):
    """The exported policy is not the trained one: which stage, which input, how much."""


def compare(stage: str, what: str, found: Tensor, expected: Tensor, states: States, tolerance: float = 0.0) -> float:
    """Return the largest difference of two [S, m] tensors.

    Args:
        stage: Name of the stage, for the error.
        what: What is compared, for the error.
        found: What the exported policy gives.
        expected: What it should give.
        states: The inputs, S of them.
        tolerance: Largest difference allowed; 0 demands equality of all bits, but for the sign of a zero.

    Raises:
        GateError: If they differ by more, or are not numbers.
    """
    if found.shape != expected.shape:
        raise GateError(f"{stage}: {what} has the shape {list(found.shape)}, not {list(expected.shape)}")
    difference = (found.double() - expected.double()).abs().nan_to_num(nan=torch.inf)
    worst = float(difference.max())
    if worst > tolerance:
        row = int(difference.max(dim=1).values.argmax())
        raise GateError(
            f"{stage}: {what} differs by {worst:.3g} (allowed: {tolerance:g}) at {states.describe(row)}: "
            f"{found[row].tolist()}, not {expected[row].tolist()}"
        )
    return worst


def one_by_one(function: Function, states: States) -> Tensor:
    """Call a function on one state after the other, as a robot does; stack what it returns, side by side."""
    return torch.cat([torch.cat(as_tuple(function(*row)), dim=1) for row in states.rows()])


def answers(policy: Any, states: States) -> Tensor:
    """What a policy, eager or scripted, gives for S states, one by one.

    Returns:
        [S, n + 1], commands and distances; of a policy that remembers [S, n + H + 1], new memories in between.
    """
    return one_by_one(lambda *row: (*as_tuple(policy(*row)), policy.distance(row[0], row[2])), states)


def split(values: Tensor, states: States) -> dict[str, Tensor]:
    """Take outputs or answers [S, ...] to S states apart, by name."""
    joints = states.joint_position.shape[1]
    end = joints + states.memory_size
    parts = {OUTPUT: values[:, :joints], NEW_MEMORY: values[:, joints:end], DISTANCE: values[:, end:]}
    return {key: part for key, part in parts.items() if part.shape[1]}


def compare_answers(stage: str, found: Tensor, expected: Tensor, states: States, tolerance: float = 0.0) -> float:
    """Compare outputs or answers, by default to the last bit; return the largest difference.

    Raises:
        GateError: If a command, a memory or a distance differs.
    """
    given = split(found, states)
    return max(
        compare(stage, key, given.get(key, found[:, :0]), part, states, tolerance)
        for key, part in split(expected, states).items()
    )


@torch.no_grad()
def check_against_env(
    policy: Deployable,
    actor: TensorDictModuleBase,
    env: TransformedRobotEnv,
    rollout: TensorDictBase,
    states: States,
) -> None:
    """The eager artifact against the policy in its environment.

    First on a rollout: views and command within rounding of what the env showed and the actor did there. Then on all
    states, one by one, through the env's own transforms: equal to the last bit.

    Args:
        policy: The artifact.
        actor: The trained actor.
        env: Its environment, with the statistics that it was trained with.
        rollout: States that the actor met there, with all keys of the env and the actions, [R].
        states: Sensor readings, S of them.

    Raises:
        GateError: If anything differs.
    """
    stage = "the artifact is not the policy in its environment"
    met = States(*(rollout.get(key) for key in policy.in_keys))
    for key, view in zip(VIEWS, policy.views(*met.sensed), strict=True):
        scale = rollout.get(key).abs().max().clamp(min=1.0)
        compare(stage, key, view / scale, rollout.get(key) / scale, met, BATCH_TOLERANCE)
    limit = env.simulation.config.max_velocity
    acted = (rollout.get("action").clamp(-1.0, 1.0) * torch.tensor(limit), rollout.get(NEW_MEMORY, None))
    for key, answer, expected in zip(policy.out_keys, as_tuple(policy(*met)), acted, strict=False):
        compare(stage, key, answer, expected, met, BATCH_TOLERANCE)

    see, act = _seeing(env), acting(actor, env)
    for row in states.rows():
        seen = see(*row)
        for key, view in zip(VIEWS, policy.views(*row.sensed), strict=True):
            compare(stage, key, view, seen.get(key), row)
        for key, answer, expected in zip(policy.out_keys, as_tuple(policy(*row)), as_tuple(act(*row)), strict=True):
            compare(stage, key, answer, expected, row)
        distance = env.simulation.observation.distance(row.joint_position, row.goal)
        compare(stage, DISTANCE, policy.distance(row.joint_position, row.goal), distance, row)


def _seeing(env: TransformedRobotEnv) -> Callable[..., TensorDictBase]:
    """What the env's own transforms make of a policy's inputs."""
    transforms = [t for t in env.transform if isinstance(t, Observation | ObservationNormalization)]

    def see(*inputs: Tensor) -> TensorDictBase:
        seen: TensorDictBase = TensorDict(States(*inputs).named(), batch_size=[len(inputs[0])])
        for transform in transforms:
            seen = transform._step(seen, seen)
        return seen

    return see


def acting(actor: TensorDictModuleBase, env: TransformedRobotEnv) -> Function:
    """The trained policy itself, behind its env's transforms, as a function of what a robot senses."""
    see, limit = _seeing(env), torch.tensor(env.simulation.config.max_velocity)

    @torch.no_grad()
    def act(*inputs: Tensor) -> tuple[Tensor, ...]:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            acted = actor(see(*inputs))
        command = acted.get("action").clamp(-1.0, 1.0) * limit
        return (command, acted.get(NEW_MEMORY)) if States(*inputs).memory_size else (command,)

    return act


def unroll(function: Function, states: States) -> Tensor:
    """Let a policy remember S states, one after the other, from a memory of zeros on.

    Returns:
        [S, n + H], commands and memories.
    """
    memory, steps = torch.zeros(1, states.memory_size), []
    for row in states.sensed.rows():
        command, memory = function(*row, memory)
        steps.append(torch.cat([command, memory], dim=1))
    return torch.cat(steps)


def check_recurrence(forms: dict[str, tuple[Function, float]], actor: Function, states: States) -> float:
    """Let forms of a policy remember S steps, each by itself, and return the largest difference to the trained policy.

    Args:
        forms: By name, with the largest difference allowed.
        actor: From ``acting``.
        states: What there is to remember.

    Raises:
        GateError: If a command or a memory differs.
    """
    expected = unroll(actor, states)
    return max(
        compare_answers(f"{name} remembers otherwise", unroll(form, states), expected, states, tolerance)
        for name, (form, tolerance) in forms.items()
    )


def ask_fresh_process(content: bytes, states: States) -> Tensor:
    """Answers of a TorchScript file in a fresh process that cannot import physai, tensordict or torchrl.

    Raises:
        GateError: If the file does not run there.
    """
    with tempfile.TemporaryDirectory() as folder:
        policy, inputs, outputs = (Path(folder) / name for name in ("policy.pt", "inputs.npz", "outputs.npy"))
        policy.write_bytes(content)
        columns: dict[str, Any] = {key: value.numpy() for key, value in states.named().items()}
        np.savez(inputs, **columns)
        command = [sys.executable, "-I", fresh_process.__file__, str(policy), str(inputs), str(outputs)]
        try:
            process = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            raise GateError(f"a fresh process without physai took longer than {PATIENCE} s") from None
        if process.returncode:
            last = (process.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise GateError(f"a fresh process without physai cannot run the file: {last[:160]}")
        return torch.from_numpy(np.load(outputs))


def check_metadata(metadata: Metadata, simulation: Simulation, expected: Tensor) -> None:
    """What a file says about itself, once it is loaded, against the robot and task that the policy was trained on.

    Args:
        metadata: Of the loaded file.
        simulation: Robot and task.
        expected: Answers to S states; no command may be beyond the limit that the file names.

    Raises:
        GateError: If a part differs; it says which.
    """
    spec, config, task = simulation.spec, simulation.config, simulation.task
    joints = len(spec.joints)
    true = {
        "robot": spec.name,
        "joints": spec.joints,
        "position_limit": spec.position_limit,
        "velocity_limit": spec.velocity_limit,
        "effort_limit": spec.effort_limit,
        "command_limit": np.full(joints, config.max_velocity),
        "control_rate": 1.0 / config.control_dt,
        "goal_frame": spec.base,
        "goal_radius": task.goal_region,
        "goal_tolerance": task.tolerance,
        "memory_size": expected.shape[1] - joints - 1,
    }
    for key, value in true.items():
        said = getattr(metadata, key)
        if not np.array_equal(said, value):
            raise GateError(f"the metadata is wrong: {key} is {said}, not {value}")
    urdf = hashlib.sha256(spec.urdf.read_bytes()).hexdigest()
    if metadata.raw["robot"]["urdf_sha256"] != urdf:
        raise GateError("the metadata is wrong: urdf_sha256 is not that of the robot's URDF")
    largest = expected[:, :joints].abs().amax(dim=0).numpy()
    if (largest > metadata.command_limit * (1 + 1e-6)).any():
        raise GateError(f"the policy commands {largest.tolist()} rad/s, beyond its limit {metadata.command_limit}")


@torch.no_grad()
def onnx_tolerance(policy: nn.Module, expected: Tensor, states: States) -> float:
    """How far ONNX Runtime's outputs may be from a policy's answers, in rad/s.

    It multiplies and adds in another order. Where a policy is so steep that single precision itself puts its answers
    farther than ``ONNX_TOLERANCE`` from those in double precision, nobody can be closer: four times that distance.
    """
    exact = copy.deepcopy(policy).double()(*(value.double() for value in states))
    rounding = float((torch.cat(as_tuple(exact), dim=1) - expected[:, :-1]).abs().max())
    return max(ONNX_TOLERANCE, 4 * rounding)


def check_onnx(runtime: Function, expected: Tensor, states: States, tolerance: float = ONNX_TOLERANCE) -> float:
    """Return the largest difference of the outputs in ONNX Runtime to answers, in rad/s.

    Raises:
        GateError: If it is larger than the tolerance.
    """
    stage, outputs = "ONNX Runtime disagrees", expected[:, :-1]
    in_a_batch = torch.cat(as_tuple(runtime(*states)), dim=1)
    return max(
        compare_answers(f"{stage} (one by one)", one_by_one(runtime, states), outputs, states, tolerance),
        compare_answers(f"{stage} (in a batch)", in_a_batch, outputs, states, tolerance),
    )


def check_drive(
    content: bytes, actor: TensorDictModuleBase, env: TransformedRobotEnv, episodes: int, seed: int
) -> Evaluation:
    """Let a TorchScript file drive the simulated robots, and return how well it did.

    Raises:
        GateError: If its success rate is not that of the actor on the same goals.
    """
    driven = evaluate(
        _Driver(content, getattr(actor, "memory_size", 0), env.simulation.config.max_velocity), env, episodes, seed
    )
    judged = evaluate(actor, env, episodes, seed)
    if abs(driven.success_rate - judged.success_rate) > SUCCESS_TOLERANCE:
        raise GateError(
            f"the artifact does not drive as the policy does: it reaches {driven.success_rate:.1%} of {episodes:,} "
            f"goals, the policy {judged.success_rate:.1%}"
        )
    return driven


class _Driver(TensorDictModuleBase):
    """A policy file in the place of the actor: sees only what a robot senses, and what it remembers."""

    def __init__(self, content: bytes, memory_size: int, max_velocity: float) -> None:
        super().__init__()
        self.in_keys, self.out_keys = input_keys(memory_size), ("action", NEW_MEMORY)[: len(output_keys(memory_size))]
        self.module = load_module(content, self.in_keys)
        self.max_velocity = max_velocity

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        command, *memory = as_tuple(self.module(*(tensordict.get(key) for key in self.in_keys)))
        return tensordict.update(dict(zip(self.out_keys, (command / self.max_velocity, *memory), strict=True)))
