"""The gate: every form of an exported policy must agree with the policy that was trained."""

import copy
import hashlib
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.artifact import fresh_process
from physai.artifact.acting import as_actor
from physai.artifact.describe import capsules
from physai.artifact.module import VIEWS, DeployablePolicy, as_tuple
from physai.artifact.states import States
from physai.deploy.metadata import ERROR, GOAL, LAST_COMMAND, MEMORY, NEW_MEMORY, POSITION, Metadata, describe_region
from physai.deploy.policy import load_module
from physai.envs.make import TransformedRobotEnv
from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.training.evaluation import Evaluation, evaluate
from physai.transforms import Observation, ObservationNormalization

BATCH_TOLERANCE = 1e-5  # rad or rad/s; a row of a batch is rounded otherwise than the same row alone
ONNX_TOLERANCE = 1e-5  # rad or rad/s
_ROUNDINGS = 16
SUCCESS_TOLERANCE = 0.01
PATIENCE = 120  # s

Function = Callable[..., Tensor | tuple[Tensor, ...]]
"""A policy: its inputs, [N, ...] each, to a command [N, n], or to a command and a new memory [N, H]."""

Answers = dict[str, Tensor]
"""What a policy gives for S states, by name, [S, ...] each: its outputs, and ``error``."""


class GateError(UserError):
    """The exported policy is not the trained one: which stage, which input, how much."""


def compare_answers(stage: str, found: Answers, expected: Answers, states: States, tolerance: float = 0.0) -> float:
    """Return the largest difference of answers, whose names are for the error.

    Args:
        stage: Name of the stage, for the error.
        found: What the exported policy gives.
        expected: What it should give.
        states: The inputs, S of them.
        tolerance: Largest difference allowed; 0 demands equality of all bits, but for the sign of a zero.

    Raises:
        GateError: If they differ by more, or are not numbers.
    """
    worst = [0.0]
    for what, wanted in expected.items():
        given = found.get(what, wanted[:, :0])
        if given.shape != wanted.shape:
            raise GateError(f"{stage}: {what} has the shape {list(given.shape)}, not {list(wanted.shape)}")
        difference = (given.double() - wanted.double()).abs().nan_to_num(nan=torch.inf)
        worst.append(float(difference.max()))
        if worst[-1] > tolerance:
            row = int(difference.max(dim=1).values.argmax())
            raise GateError(
                f"{stage}: {what} differs by {worst[-1]:.3g} (allowed: {tolerance:g}) at {states.describe(row)}: "
                f"{given[row].tolist()}, not {wanted[row].tolist()}"
            )
    return max(worst)


def outputs(function: Function, policy: DeployablePolicy, states: States) -> Answers:
    """Call a function on one state after the other, as a robot does, and name what it returns."""
    return _named(policy.out_keys, (as_tuple(function(*row.values())) for row in states.rows()))


def answers(form: Any, policy: DeployablePolicy, states: States) -> Answers:
    """What a form of a policy, eager or scripted, gives for S states, one by one."""

    def answer(row: States) -> tuple[Tensor, ...]:
        told = as_tuple(form(*row.values()))
        return (*told, form.error(row[POSITION], row[GOAL])) if policy.measures else told

    return _named(policy.answer_keys, map(answer, states.rows()))


def _named(names: Sequence[str], rows: Iterable[Sequence[Tensor]]) -> Answers:
    return {name: torch.cat(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


@torch.no_grad()
def check_against_env(
    policy: DeployablePolicy,
    actor: TensorDictModuleBase,
    env: TransformedRobotEnv,
    rollout: TensorDictBase,
    states: States,
) -> None:
    """The eager artifact against the policy in its environment.

    First on a rollout: views and command within rounding of what the env showed, and told its robots, there. Then on
    all states, one by one, through the env's own transforms: equal to the last bit.

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
    met = States({key: rollout.get(key) for key in policy.in_keys})
    for key, view in zip(VIEWS, policy.views(met), strict=True):
        scale = rollout.get(key).abs().max().clamp(min=1.0)
        compare_answers(stage, {key: view / scale}, {key: rollout.get(key) / scale}, met, BATCH_TOLERANCE)
    told = env.simulation.joint_command.of_arrays(
        *(rollout.get(key, rollout.get(POSITION)).numpy() for key in ("action", POSITION, LAST_COMMAND))
    )
    acted = dict(zip(policy.out_keys, (torch.from_numpy(told).float(), rollout.get(NEW_MEMORY, None)), strict=False))
    compare_answers(stage, _named(policy.out_keys, [as_tuple(policy(*met.values()))]), acted, met, BATCH_TOLERANCE)

    see, act, error = _seeing(env), acting(actor, env), env.simulation.task.module.error
    seen = map(see, states.rows())
    found = _named(VIEWS, map(policy.views, states.rows())) | answers(policy, policy, states)
    expected = _named(VIEWS, ([one.get(key) for key in VIEWS] for one in seen)) | outputs(act, policy, states)
    if policy.measures:
        expected[ERROR] = torch.cat([error(row[POSITION], row[GOAL]) for row in states.rows()])
    compare_answers(stage, found, expected, states)


def _seeing(env: TransformedRobotEnv) -> Callable[[States], TensorDictBase]:
    """What the env's own transforms make of a policy's inputs."""
    transforms = [t for t in env.transform if isinstance(t, Observation | ObservationNormalization)]

    def see(states: States) -> TensorDictBase:
        seen: TensorDictBase = TensorDict(dict(states), batch_size=[len(states)])
        for transform in transforms:
            seen = transform._step(seen, seen)
        return seen

    return see


def acting(actor: TensorDictModuleBase, env: TransformedRobotEnv) -> Function:
    """The trained policy itself, behind its env's transforms, as a function of what a robot senses."""
    see, memory_size = _seeing(env), getattr(actor, "memory_size", 0)
    names = [*(signal.name for signal in env.simulation.sensed), *([MEMORY] if memory_size else [])]

    @torch.no_grad()
    def act(*inputs: Tensor) -> tuple[Tensor, ...]:
        states = States(zip(names, inputs, strict=True))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            acted = actor(see(states))
        position = states[POSITION]
        action = acted.get("action").clamp(-1.0, 1.0)
        command = env.simulation.joint_command(action, position, states.get(LAST_COMMAND, position))
        return (command, acted.get(NEW_MEMORY)) if memory_size else (command,)

    return act


def unroll(function: Function, policy: DeployablePolicy, states: States) -> Answers:
    """Let a policy remember S states, one after the other, from a memory of zeros on."""
    memory = torch.zeros_like(states[MEMORY][:1])

    def remember(*inputs: Tensor) -> tuple[Tensor, ...]:
        nonlocal memory
        command, memory = function(*inputs[:-1], memory)
        return command, memory

    return outputs(remember, policy, states)


def check_recurrence(
    forms: dict[str, tuple[Function, float]], actor: Function, policy: DeployablePolicy, states: States
) -> float:
    """Let forms of a policy remember S steps, each by itself, and return the largest difference to the trained policy.

    Args:
        forms: By name, with the largest difference allowed.
        actor: From ``acting``.
        policy: The artifact.
        states: What there is to remember.

    Raises:
        GateError: If a command or a memory differs.
    """
    expected = unroll(actor, policy, states)
    return max(
        compare_answers(f"{name} remembers otherwise", unroll(form, policy, states), expected, states, tolerance)
        for name, (form, tolerance) in forms.items()
    )


def ask_fresh_process(content: bytes, policy: DeployablePolicy, states: States) -> Answers:
    """Answers of a TorchScript file in a fresh process that cannot import physai, tensordict or torchrl.

    Raises:
        GateError: If the file does not run there.
    """
    with tempfile.TemporaryDirectory() as folder:
        file, inputs, given = (Path(folder) / name for name in ("policy.pt", "inputs.npz", "outputs.npz"))
        file.write_bytes(content)
        columns: dict[str, Any] = {key: value.numpy() for key, value in states.items()}
        np.savez(inputs, **columns)
        command = [sys.executable, "-I", fresh_process.__file__, str(file), str(inputs), str(given)]
        try:
            process = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
        except subprocess.TimeoutExpired as error:
            raise GateError(f"a fresh process without physai took longer than {PATIENCE} s") from error
        if process.returncode:
            last = (process.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise GateError(f"a fresh process without physai cannot run the file: {last[:160]}")
        with np.load(given) as arrays:
            return dict(zip(policy.answer_keys, map(torch.from_numpy, arrays.values()), strict=True))


def check_metadata(metadata: Metadata, simulation: Simulation, policy: DeployablePolicy, expected: Answers) -> None:
    """What a file says about itself, once it is loaded, against the robot and task that the policy was trained on.

    Args:
        metadata: Of the loaded file.
        simulation: Robot and task.
        policy: The artifact.
        expected: Its answers; no command may be beyond the bounds that the file names.

    Raises:
        GateError: If a part differs; it says which.
    """
    spec, task = simulation.spec, simulation.task
    of_robot = ("joints", "home", "position_limit", "velocity_limit", "effort_limit", "command_limit")
    true = {key: getattr(spec, key) for key in of_robot} | {
        "robot": spec.name,
        "control_rate": 1.0 / simulation.config.control_dt,
        "inputs": policy.inputs,
        "outputs": policy.outputs,
        "tolerances": task.tolerances,
    }
    for key, value in true.items():
        said = getattr(metadata, key)
        if not (np.array_equal(said, value) if isinstance(value, np.ndarray) else said == value):
            raise GateError(f"the metadata is wrong: {key} is {said}, not {value}")
    model = capsules(simulation)
    described = {
        "goal.region": (describe_region(metadata.region), describe_region(task.region)),
        "collision": tuple(None if each is None else each.describe() for each in (metadata.collision, model)),
    }
    for key, (said, value) in described.items():
        if said != value:
            raise GateError(f"the metadata is wrong: {key} is {said}, not {value}")
    urdf = hashlib.sha256(spec.urdf.read_bytes()).hexdigest()
    if metadata.raw["robot"]["urdf_sha256"] != urdf:
        raise GateError("the metadata is wrong: urdf_sha256 is not that of the robot's URDF")
    command, (low, high) = expected[metadata.command.name].double().numpy(), metadata.command.bounds
    room = 1e-6 * np.maximum(np.abs(low), np.abs(high))
    if not ((command >= low - room) & (command <= high + room)).all():
        far = command[int(np.maximum(low - command, command - high).max(axis=1).argmax())].tolist()
        unit = metadata.command.unit
        raise GateError(f"the policy commands {far} {unit}, beyond its limits {low.tolist()} to {high.tolist()}")


@torch.no_grad()
def onnx_tolerance(policy: DeployablePolicy, expected: Answers, states: States) -> float:
    """How far ONNX Runtime's outputs may be from a policy's answers.

    It adds in another order, and its sines differ in the last bits. Where a policy is so steep that single precision
    itself puts its answers farther than ``ONNX_TOLERANCE`` from those in double precision, nobody can be closer than
    some times that distance: inverse kinematics of a pose 6 m away were seen 7 times as far.
    """
    exact = as_tuple(copy.deepcopy(policy).double()(*(value.double() for value in states.values())))
    rounding = max(float((e - expected[key]).abs().max()) for key, e in zip(policy.out_keys, exact, strict=True))
    return max(ONNX_TOLERANCE, _ROUNDINGS * rounding)


def check_onnx(
    runtime: Function,
    policy: DeployablePolicy,
    expected: Answers,
    states: States,
    tolerance: float = ONNX_TOLERANCE,
) -> float:
    """Return the largest difference of the outputs in ONNX Runtime to answers.

    Raises:
        GateError: If it is larger than the tolerance.
    """
    stage, wanted = "ONNX Runtime disagrees", {key: expected[key] for key in policy.out_keys}
    in_a_batch = _named(policy.out_keys, [as_tuple(runtime(*states.values()))])
    return max(
        compare_answers(f"{stage} (one by one)", outputs(runtime, policy, states), wanted, states, tolerance),
        compare_answers(f"{stage} (in a batch)", in_a_batch, wanted, states, tolerance),
    )


def check_drive(
    content: bytes,
    policy: DeployablePolicy,
    actor: TensorDictModuleBase,
    env: TransformedRobotEnv,
    episodes: int,
    seed: int,
) -> Evaluation:
    """Let a TorchScript file drive the simulated robots, and return how well it did.

    Raises:
        GateError: If its rates of success and of failures are not those of the actor on the same goals.
    """
    driven = drive(content, policy, env, episodes, seed)
    trained = evaluate(actor, env, episodes, seed)
    for what in ("success", "crashed"):
        found, wanted = (float(getattr(each, what).double().mean()) for each in (driven, trained))
        by_chance = _by_chance(wanted, episodes) if env.simulation.spec.floating is not None else 0.0
        if abs(found - wanted) > max(SUCCESS_TOLERANCE, by_chance):
            raise GateError(
                f"the artifact does not drive as the policy does: of {episodes:,} episodes, {found:.1%} are "
                f"{'a success' if what == 'success' else 'ended by a failure'}, of the policy's {wanted:.1%}"
            )
    return driven


def _by_chance(rate: float, episodes: int) -> float:
    """How far the rates of two runs may be apart, in all but one of a thousand.

    Feet that touch the floor a moment sooner make another run of it: rounding alone does that to robots on legs.
    """
    rate = min(max(rate, 1 / episodes), 1 - 1 / episodes)
    return 3.3 * math.sqrt(2 * rate * (1 - rate) / episodes)


def drive(content: bytes, policy: DeployablePolicy, env: TransformedRobotEnv, episodes: int, seed: int) -> Evaluation:
    """Evaluate a TorchScript file in the place of the actor: it sees what a robot senses, and what it remembers."""
    module = load_module(content, policy.in_keys, policy.measures)
    actor = as_actor(module, policy.in_keys, policy.out_keys, env.simulation.joint_command)
    return evaluate(actor, env, episodes, seed)
