"""Exporting a policy: no file appears before every form of it agrees with the policy that was trained."""

import hashlib
import json
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from physai.artifact import describe, gate, onnx, transfer
from physai.artifact.module import DeployablePolicy, make_deployable, save, script
from physai.artifact.states import States, extreme_states, roll_out
from physai.deploy import Metadata, PolicyError, load_policy
from physai.deploy.archive import content_sha256
from physai.deploy.metadata import metadata_sha256
from physai.deploy.policy import load_module
from physai.envs.make import TransformedRobotEnv
from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.files import write_atomically
from physai.seeding import derive
from physai.training.config import TrainConfig
from physai.training.evaluation import Evaluation
from physai.training.run import TrainedPolicy, git_commit

FILES = {"torchscript": "policy.pt", "onnx": "policy.onnx"}
EPISODES = 200  # that the artifact drives before it is written
TRANSFER_EPISODES, TRANSFER_STEPS = 1000, 200_000  # at most, in the other engine
_STEPS_ON_LEGS = 50_000  # where nothing depends on it: PyBullet steps 500 robots on legs in a second
GOLDEN_PAIRS = 32
SEED = derive(0, "export")
_ROBOTS = 200


def export_policy(
    run_dir: Path,
    which: str,
    formats: Sequence[str],
    report: Callable[[str, str], None] = lambda stage, result: None,
    episodes: int = EPISODES,
    config: TrainConfig | None = None,
) -> Metadata:
    """Export a policy of a run into its folder, through the gate.

    Args:
        run_dir: The run folder; the files of ``FILES`` are written there, and ``policy.pt.sha256``.
        which: ``best``, ``last``, or a number of frames.
        formats: Keys of ``FILES``.
        report: Called with the name of each stage that was passed, and how.
        episodes: How many the artifact drives.
        config: The run's, where it is known; None reads it from the run folder.

    Returns:
        What the files say about themselves.

    Raises:
        GateError: If any two forms of the policy disagree, or it fails in the other engine and the run requires that it
            does not; nothing is written.
        UserError: If there is no such policy, or it cannot be exported.
    """
    trained = TrainedPolicy(run_dir, which, config=config)
    required = trained.config.export.transfer == "require"
    if required:
        try:
            transfer.other_engine(trained.config.env.physics)
        except UserError as error:
            raise gate.GateError(f"export.transfer=require: {error}") from error
    actor, env = trained.deploy(_ROBOTS, SEED)
    with closing(env):
        forms = agreeing_forms(actor, env, formats, report)
        driven = gate.check_drive(forms.content, forms.policy, actor, env, episodes, SEED)
        report(f"drives {episodes:,} episodes", f"{_how_well(driven)}, as the policy does")
        steps = TRANSFER_STEPS if required or env.simulation.spec.floating is None else _STEPS_ON_LEGS
        short = min(TRANSFER_EPISODES, max(1, steps // env.simulation.task.max_steps))
        opinion = _second_opinion(forms.content, forms.policy, trained, short, report)
        if opinion is not None and required:
            opinion.require(driven)
        described = {
            **describe.describe_origin(git_commit()),
            "checkpoint": {"which": which, "frames": trained.frames},
            "evaluation": {
                **driven.summary(),
                "episodes": episodes,
                "randomization": trained.randomization.name,
                "transfer": opinion and opinion.summary(),
            },
            "config": trained.config.model_dump(mode="json"),
        }
        return write(run_dir, formats, forms, env.simulation, described)


@dataclass(frozen=True)
class Forms:
    """A policy in forms that agree.

    Attributes:
        policy: The artifact.
        scripted: It in TorchScript.
        content: The file of that, without metadata.
        onnx: The file for ONNX Runtime, without metadata; None where none was asked for.
        tolerance: How far ONNX Runtime's commands may be from the artifact's, rad or rad/s.
        states: What they were asked.
        expected: What the artifact answers.
    """

    policy: DeployablePolicy
    scripted: torch.jit.ScriptModule
    content: bytes
    onnx: bytes | None
    tolerance: float
    states: States
    expected: gate.Answers


def agreeing_forms(
    actor: TensorDictModuleBase, env: TransformedRobotEnv, formats: Sequence[str], report: Callable[[str, str], None]
) -> Forms:
    """Turn a trained policy into all forms that were asked for, and let each answer the same states.

    Raises:
        GateError: If any two forms disagree.
    """
    policy = make_deployable(actor, env)
    rollout, extremes = roll_out(actor, env), extreme_states(policy, env)
    work = States({key: rollout.get(key) for key in policy.in_keys})
    states = States({key: torch.cat([work[key], extremes[key]]) for key in policy.in_keys})
    tried = f"{len(work):,} states of its work, {len(extremes):,} extremes"
    gate.check_against_env(policy, actor, env, rollout, states)
    report("the artifact is the policy", f"{tried}: equal to the last bit")

    scripted = script(policy)
    content = save(scripted)
    loaded = load_module(content, policy.in_keys, policy.measures)
    expected = gate.answers(policy, policy, states)
    for stage, found in (
        ("TorchScript is not the artifact", gate.answers(scripted, policy, states)),
        ("the loaded file is not the artifact", gate.answers(loaded, policy, states)),
        ("a fresh process disagrees", gate.ask_fresh_process(content, policy, states)),
    ):
        gate.compare_answers(stage, found, expected, states)
    report("TorchScript, also in a fresh process", "equal to the last bit")

    converted = onnx.convert(policy, states) if "onnx" in formats else None
    tolerance = gate.onnx_tolerance(policy, expected, states)
    if converted is not None:
        worst = gate.check_onnx(onnx.Runtime(converted), policy, expected, states, tolerance)
        report("ONNX in ONNX Runtime", f"within {worst:.1e} {policy.outputs[0].unit}")

    if policy.memory_size:
        remembering: dict[str, tuple[gate.Function, float]] = {"the artifact": (policy, 0.0), "the file": (loaded, 0.0)}
        if converted is not None:
            remembering["ONNX Runtime"] = (onnx.Runtime(converted), tolerance)
        worst = gate.check_recurrence(remembering, gate.acting(actor, env), policy, work)
        others = f", ONNX within {worst:.1e}" if converted is not None else ""
        report("remembers as the policy does", f"over {len(work):,} steps: to the last bit{others}")
    return Forms(policy, scripted, content, converted, tolerance, states, expected)


def write(
    run_dir: Path, formats: Sequence[str], forms: Forms, simulation: Simulation, described: dict[str, Any]
) -> Metadata:
    """Write the files of forms that agree, once what they say about themselves is true.

    Args:
        run_dir: Where to.
        formats: Keys of ``FILES``.
        forms: From ``agreeing_forms``.
        simulation: Robot and task.
        described: What else the files say: where they are from, and how the policy drives.

    Returns:
        What the files say about themselves.

    Raises:
        GateError: If a file says what is not so; nothing is written.
    """
    described = {
        **described,
        **describe.describe_robot(simulation, forms.policy),
        "golden": describe.golden_pairs(forms.states, forms.expected, GOLDEN_PAIRS),
        "content_sha256": content_sha256(forms.content),
    }
    described["metadata_sha256"] = metadata_sha256(described)
    text = json.dumps(described, allow_nan=False)
    final = save(forms.scripted, text)
    metadata = _load_as_a_robot_would(final)
    gate.check_metadata(metadata, simulation, forms.policy, forms.expected)
    if forms.onnx is not None and "onnx" in formats:
        final_onnx = onnx.describe(forms.onnx, text)
        gate.check_onnx(onnx.Runtime(final_onnx), forms.policy, forms.expected, forms.states, forms.tolerance)
        if onnx.read_metadata(final_onnx) != text:
            raise gate.GateError("the metadata of the ONNX file is not that of the policy")
        write_atomically(run_dir / FILES["onnx"], final_onnx)
    if "torchscript" in formats:
        _publish(run_dir / FILES["torchscript"], final)
    return metadata


def _second_opinion(
    content: bytes,
    policy: DeployablePolicy,
    trained: TrainedPolicy,
    episodes: int,
    report: Callable[[str, str], None],
) -> transfer.Opinion | None:
    """Ask the other engine; None where it cannot be asked and need not be."""
    try:
        opinion = transfer.ask(content, policy, trained, episodes, SEED)
    except UserError as error:
        if trained.config.export.transfer == "require":
            raise
        report("drives in the other engine", f"not asked: {error}")
        return None
    name = f"drives in {opinion.physics['_target_'].rpartition('.')[2].removesuffix('Physics')}"
    report(name, f"{opinion.episodes:,} episodes: {_how_well(opinion.evaluation)}")
    for difference in opinion.differences:
        report("", difference)
    return opinion


def _how_well(driven: Evaluation) -> str:
    if not driven.mean_error:
        return f"reaches {driven.success_rate:.1%} of the goals, stays at {driven.settled_rate:.1%}"
    off = ", ".join(f"{mean:.3f} {unit}" for mean, unit in driven.mean_error.values())
    return f"fails in {float(driven.crashed.double().mean()):.1%}, is off by {off}"


def _load_as_a_robot_would(content: bytes) -> Metadata:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / FILES["torchscript"]
        path.write_bytes(content)
        try:
            policy = load_policy(path, hashlib.sha256(content).hexdigest())
        except PolicyError as error:
            raise gate.GateError(f"the loader refuses the file: {str(error).removeprefix(f'{path}: ')}") from error
    if policy.golden_error:
        raise gate.GateError(f"the loaded file differs from its golden pairs by {policy.golden_error:.3g}")
    return policy.metadata


def _publish(path: Path, content: bytes) -> None:
    """Write a policy and its hash; a kill in between leaves a policy without a hash, never one with a wrong hash."""
    beside = path.with_name(f"{path.name}.sha256")
    beside.unlink(missing_ok=True)
    write_atomically(path, content)
    write_atomically(beside, f"{hashlib.sha256(content).hexdigest()}  {path.name}\n".encode())
