"""Exporting a policy: no file appears before every form of it agrees with the policy that was trained."""

import hashlib
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from physai.artifact import describe, gate, onnx
from physai.artifact.module import make_deployable, save, script
from physai.artifact.states import States, extremes, visit
from physai.deploy import Metadata, load_policy
from physai.deploy.archive import content_sha256
from physai.deploy.metadata import INPUTS, OUTPUT
from physai.seeding import derive
from physai.training.checkpoint import write
from physai.training.run import TrainedPolicy, git_commit

FILES = {"torchscript": "policy.pt", "onnx": "policy.onnx"}
EPISODES = 200  # that the artifact drives before it is written
GOLDEN_PAIRS = 32
SEED = derive(0, "export")
_ROBOTS = 200


def export_policy(
    run_dir: Path,
    which: str,
    formats: Sequence[str],
    report: Callable[[str, str], None] = lambda stage, result: None,
    episodes: int = EPISODES,
) -> Metadata:
    """Export a policy of a run into its folder, through the gate.

    Args:
        run_dir: The run folder; the files of ``FILES`` are written there, and ``policy.pt.sha256``.
        which: ``best``, ``last``, or a number of frames.
        formats: Keys of ``FILES``.
        report: Called with the name of each stage that was passed, and how.
        episodes: How many the artifact drives.

    Raises:
        GateError: If any two forms of the policy disagree; nothing is written.
        UserError: If there is no such policy, or it cannot be exported.
    """
    trained = TrainedPolicy(run_dir, which)
    actor, env = trained.deploy(min(episodes, _ROBOTS), SEED)
    try:
        policy = make_deployable(actor, env)
        moments, edges = visit(actor, env), extremes(env)
        met = States(*(moments.get(key) for key in INPUTS))
        states = States(*(torch.cat(pair) for pair in zip(met, edges, strict=True)))
        tried = f"{len(met.goal):,} states of its work, {len(edges.goal):,} extremes"
        gate.check_against_env(policy, actor, env, moments, states)
        report("the artifact is the policy", f"{tried}: equal to the last bit")

        scripted = script(policy)
        bare = save(scripted)
        expected = gate.each(policy, states)
        gate.compare("TorchScript is not the artifact", OUTPUT, gate.each(scripted, states), expected, states)
        gate.compare("a fresh process disagrees", OUTPUT, gate.run_stranger(bare, states), expected, states)
        report("TorchScript, also in a fresh process", "equal to the last bit")

        converted = onnx.convert(policy, states) if "onnx" in formats else b""
        if converted:
            worst = gate.check_onnx(onnx.Runtime(converted), expected, states)
            report("ONNX in ONNX Runtime", f"within {worst:.1e} rad/s")

        driven = gate.check_drive(bare, actor, env, episodes, SEED)
        report(f"drives {episodes:,} episodes", f"reaches {driven.success_rate:.1%} of the goals, as the policy does")

        content = {
            **describe.describe_origin(git_commit()),
            **describe.describe_robot(env.simulation),
            "checkpoint": {"which": which, "frames": trained.frames},
            "evaluation": {**driven.summary(), "episodes": episodes, "randomization": trained.randomization.name},
            "config": trained.config.model_dump(mode="json"),
            "golden": describe.golden_pairs(met, expected[: len(met.goal)], GOLDEN_PAIRS),
            "content_sha256": content_sha256(bare),
        }
        metadata = json.dumps(content, allow_nan=False)
        final = save(scripted, metadata)
        checked = _load_as_a_robot_would(final, env.simulation.spec.joints)
        if converted:
            described = onnx.describe(converted, metadata)
            gate.check_onnx(onnx.Runtime(described), expected, states)
            write(run_dir / FILES["onnx"], described)
        if "torchscript" in formats:
            _publish(run_dir / FILES["torchscript"], final)
        return checked
    finally:
        env.close()


def _load_as_a_robot_would(content: bytes, joints: Sequence[str]) -> Metadata:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / FILES["torchscript"]
        path.write_bytes(content)
        policy = load_policy(path, hashlib.sha256(content).hexdigest(), joints)
    if policy.golden_error:
        raise gate.GateError(f"the loaded file differs from its golden pairs by {policy.golden_error:.3g} rad/s")
    return policy.metadata


def _publish(path: Path, content: bytes) -> None:
    """Write a policy and its hash; a kill in between leaves a policy without a hash, never one with a wrong hash."""
    beside = path.with_name(f"{path.name}.sha256")
    beside.unlink(missing_ok=True)
    write(path, content)
    write(beside, f"{hashlib.sha256(content).hexdigest()}  {path.name}\n".encode())
