"""Policy files taken apart and put together, for tests of what a loader refuses."""

import io
import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from physai.deploy import Policy, PolicyError, load_policy
from physai.deploy.archive import content_sha256
from physai.deploy.metadata import metadata_sha256

METADATA = "archive/extra/metadata.json"
GOLDEN = ("joint_position", "joint_velocity", "goal")


def refusal(path: Path, **kwargs) -> str:
    """What load_policy says of a file that it refuses: always one printable line that begins with the path."""
    with pytest.raises(PolicyError) as error:
        load_policy(path, **kwargs)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert message.isprintable()  # no line break, nothing that moves a terminal's cursor
    assert len(message) < 1500
    return message.removeprefix(f"{path}: ")


def records(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def pack(records: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", compression) as archive:
        for name, data in records.items():
            archive.writestr(name, data)
    return target.getvalue()


def sign(records: dict[str, bytes]) -> dict[str, bytes]:
    """What a forger would do: describe the records as they are now."""
    metadata = json.loads(records[METADATA]) | {"content_sha256": content_sha256(pack(records))}
    metadata["metadata_sha256"] = metadata_sha256(metadata)
    return records | {METADATA: json.dumps(metadata).encode()}


def described(content: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """The file with changed metadata."""
    good = records(content)
    metadata = json.loads(good[METADATA])
    change(metadata)
    return pack(sign(good | {METADATA: json.dumps(metadata).encode()}))


def save(scripted: torch.jit.ScriptModule, metadata: str | None = None) -> bytes:
    """The content of a policy file."""
    written = io.BytesIO()
    torch.jit.save(scripted, written, _extra_files=None if metadata is None else {"metadata.json": metadata})
    return pack({name: data for name, data in records(written.getvalue()).items() if not name.endswith(".debug_pkl")})


def commands(policy: Policy, golden: dict[str, np.ndarray]) -> np.ndarray:
    return np.array([policy(*inputs) for inputs in zip(*(golden[key] for key in GOLDEN), strict=True)])


def refused_or_unchanged(path: Path, original: Policy) -> bool:
    """Whether a file is refused; one that is not must be the original in all but the look of its zip."""
    try:
        policy = load_policy(path)
    except PolicyError:
        refusal(path)
        return True
    golden = original.metadata.golden
    assert policy.golden_error == 0.0
    assert np.array_equal(commands(policy, golden), golden["joint_velocity_command"])
    assert policy.metadata.raw == original.metadata.raw
    return False


LOAD = """
import sys
from physai.deploy import PolicyError, load_policy
for path in sys.argv[1:]:
    try:
        print("loaded:", load_policy(path).golden_error)
    except PolicyError as error:
        print("refused:", error)
"""


def load_elsewhere(*paths: Path, program: str = LOAD) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, paths)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, f"exit code {done.returncode}: {done.stderr[-500:]}"
    return done.stdout.splitlines()
