"""``python -m physai.export``: turn the policy of a run into files for robots (see ``--help``)."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from omegaconf import DictConfig

from physai import cli
from physai.config import Config, PackageName, validate
from physai.errors import UserError
from physai.files import write_atomically

if TYPE_CHECKING:
    from physai.training.config import TrainConfig


class ExportConfig(Config):
    """``conf/export.yaml``."""

    run: str | None
    allow: list[PackageName]
    checkpoint: str | int
    format: Literal["torchscript", "onnx", "all"]
    inspect: str | None

    @property
    def formats(self) -> list[str]:
        """Which files to write."""
        return ["torchscript", "onnx"] if self.format == "all" else [self.format]


def _check(node: DictConfig) -> None:
    from physai.artifact import onnx
    from physai.training.run import TrainedPolicy, load_config

    config = validate(ExportConfig, node)
    if (config.run is None) == (config.inspect is None):
        either = "run=<run folder> to export, or inspect=<policy.pt> to look at a policy"
        raise UserError(f"{'not both' if config.run else 'needed'}: {either}")
    if config.run is None:
        return
    if "onnx" in config.formats and onnx.missing():
        raise UserError(
            f"ONNX needs {', '.join(onnx.missing())}: pip install 'physai[onnx]', or choose format=torchscript"
        )
    run = Path(config.run)
    TrainedPolicy(run, str(config.checkpoint), config=load_config(run, config.allow))


def _export(node: DictConfig, _: Path) -> None:
    config = validate(ExportConfig, node)
    if config.inspect is not None:
        from physai.artifact.inspect import show

        show(Path(config.inspect))
    else:
        assert config.run is not None
        from physai.training.run import load_config

        run = Path(config.run)
        export(run, str(config.checkpoint), config.formats, load_config(run, config.allow))


def export(run_dir: Path, which: str, formats: Sequence[str], config: "TrainConfig") -> None:
    """Export a policy through the gate, and say what was checked and written."""
    from physai.artifact import FILES, export_policy

    print(f"Exporting the {which} policy of {run_dir}:", flush=True)

    def report(stage: str, result: str) -> None:
        print(f"  {stage:<38} {result}", flush=True)

    metadata = export_policy(run_dir, which, formats, report, config=config)
    if which == "best":
        _note(run_dir, metadata.raw["evaluation"]["transfer"])
    written = [FILES[name] for name in formats]
    print(
        f"Written to {run_dir}: {', '.join(written)}{', policy.pt.sha256' if FILES['torchscript'] in written else ''}"
    )
    for other in set(FILES.values()) - set(written):
        if (run_dir / other).exists():
            print(f"{other} is from an earlier export, perhaps of another checkpoint")


def _note(run_dir: Path, transfer: dict[str, Any] | None) -> None:
    """Add to the summary of a run how its best policy drives in the other engine."""
    path = run_dir / "summary.json"
    if transfer is None or not path.is_file():
        return
    try:
        summary = dict(json.loads(path.read_text()))
    except (ValueError, TypeError, RecursionError) as error:
        raise UserError(f"{path}: the run's summary is damaged") from error
    write_atomically(path, json.dumps(summary | {"transfer": transfer}, indent=2).encode())


if __name__ == "__main__":
    cli.main("export", _export, _check)
