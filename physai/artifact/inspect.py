"""What a policy file says about itself, for people."""

import hashlib
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from physai.artifact import onnx
from physai.deploy import Metadata, PolicyError, archive, read_metadata
from physai.errors import UserError
from physai.signals import Signal
from physai.training.run import rate


def show(path: Path) -> None:
    """Print the metadata of a ``policy.pt`` or ``policy.onnx``; nothing in the file is run.

    Raises:
        PolicyError: If it is no policy file, or damaged.
        UserError: If an ONNX file cannot be read.
    """
    metadata = _read_onnx(path) if path.suffix == ".onnx" else read_metadata(path)
    console = Console()
    config = yaml.safe_dump(metadata.raw["config"], sort_keys=False)
    console.print(config, highlight=False, markup=False, soft_wrap=True)
    try:
        console.print(_summary(path, metadata))
    except (KeyError, TypeError, ValueError) as error:  # of the parts that no robot needs
        raise PolicyError(f"{path}: the metadata lacks {error}") from error
    console.print(_joints(metadata))


def _read_onnx(path: Path) -> Metadata:
    if onnx.missing():
        raise UserError(f"ONNX needs {', '.join(onnx.missing())}: pip install 'physai[onnx]'")
    try:
        text = onnx.read_metadata(archive.read(path))
        if text is None:
            raise PolicyError("an ONNX file, but no physai policy")
        return Metadata.parse(text)
    except UserError as error:
        raise PolicyError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error


def _summary(path: Path, metadata: Metadata) -> Table:
    raw = metadata.raw
    evaluation, tip = raw["evaluation"], raw["robot"]["end_effector"]
    rows = {
        "robot": f"{metadata.robot}, " + (f"end effector {tip}" if tip else "on legs" if metadata.floats else ""),
        "URDF SHA-256": raw["robot"]["urdf_sha256"],
        "inputs": _shapes(metadata.inputs),
        "outputs": _shapes(metadata.outputs),
        "control rate": f"{metadata.control_rate:g} Hz",
        "goals": _goals(metadata),
        "driven by this file": f"{evaluation['episodes']:,} goals, randomization {evaluation['randomization']}",
        "success": rate(evaluation, "success"),
        "settled": rate(evaluation, "settled"),
        **_transfer(evaluation["transfer"]),
        "checkpoint": f"{raw['checkpoint']['which']}, {raw['checkpoint']['frames']:,} frames",
        "golden pairs": str(len(metadata.golden[metadata.goal.name])),
        "versions": ", ".join(f"{name} {version}" for name, version in raw["versions"].items()),
        "git commit": str(raw["git_commit"]),
        "created": raw["created"],
        "file": f"SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()}",
    }
    table = Table(title=escape(str(path)), show_header=False, title_justify="left")
    table.add_column()
    table.add_column(overflow="fold")  # hashes are worth nothing when they are cut
    for key, value in rows.items():
        table.add_row(key, escape(value))
    return table


def _transfer(transfer: dict[str, Any] | None) -> dict[str, str]:
    if transfer is None:
        return {}
    engine = transfer["physics"]["_target_"].rpartition(".")[2].removesuffix("Physics")
    return {f"{what} in {engine}": rate(transfer, what) for what in ("success", "settled")}


def _joints(metadata: Metadata) -> Table:
    table = Table(title="Joints, in the policy's order", title_justify="left")
    command = "command, rad from home" if metadata.floats else "command, rad/s"
    for column in ("joint", "position, rad", "velocity, rad/s", "effort, N m", command):
        table.add_column(column, justify="left" if column == "joint" else "right")
    limits = (metadata.position_limit, metadata.velocity_limit, metadata.effort_limit, metadata.command_limit)
    for name, (lower, upper), velocity, effort, command in zip(metadata.joints, *limits, strict=True):
        table.add_row(escape(name), f"{lower:g} to {upper:g}", f"{velocity:g}", f"{effort:g}", f"±{command:g}")
    return table


def _shapes(signals: tuple[Signal, ...]) -> str:
    return ", ".join(f"{signal.name} {list(signal.shape)} {signal.unit}".rstrip() for signal in signals)


def _goals(metadata: Metadata) -> str:
    region = ", ".join(f"{key} {value}" for key, value in vars(metadata.region).items())
    near = ", ".join(f"{one.name} {one.value:g} {one.unit}" for one in metadata.tolerances)
    frame = f" in frame '{metadata.goal.frame}'" if metadata.goal.frame else ""
    return f"{metadata.goal.quantity.value}{frame}, {metadata.region.kind}: {region}; within: {near}"
