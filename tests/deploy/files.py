"""Policy files taken apart and put together, for tests of what a loader refuses."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

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


def commands(policy: Policy, golden: dict[str, np.ndarray]) -> np.ndarray:
    return np.array([policy(*inputs) for inputs in zip(*(golden[key] for key in GOLDEN), strict=True)])
