"""Zips that lie about what is in them, and code that would run while a file is loaded: refused, and not run."""

import io
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from physai.deploy import PolicyError, load_policy, read_metadata
from physai.deploy.archive import MAX_BYTES
from tests.deploy.files import (
    METADATA,
    commands,
    load_elsewhere,
    pack,
    records,
    refusal,
    refused_or_unchanged,
    save,
    sign,
)

# --- zips that lie


def patch(content: bytes, name: str, offset: int, value: bytes) -> bytes:
    """Overwrite something in a record's entry of the directory."""
    patched = bytearray(content)
    at = content.rindex(name.encode()) - 46 + offset
    assert content[at - offset : at - offset + 4] == b"PK\1\2"
    patched[at : at + len(value)] = value
    return bytes(patched)


@pytest.mark.parametrize(
    ("offset", "value"),
    [
        (8, struct.pack("<H", 0x0001)),
        (8, struct.pack("<H", 0x0041)),
        (8, struct.pack("<H", 0x0020)),
        (10, struct.pack("<H", 8)),
        (10, struct.pack("<H", 99)),
        (16, bytes(4)),
        (20, struct.pack("<L", 0xFFFFFFF0)),
        (20, struct.pack("<L", 3)),
        (24, struct.pack("<L", 0xFFFFFFF0)),
        (24, struct.pack("<L", 3)),
        (24, struct.pack("<L", 0xFFFFFFFF)),
        (42, struct.pack("<L", 0xFFFFFFF0)),
        (42, struct.pack("<L", 0)),
    ],
    ids=[
        "encrypted",
        "strongly encrypted",
        "a patch",
        "compressed, it says",
        "compressed in an unknown way",
        "a wrong checksum",
        "impossibly long when compressed",
        "shorter when compressed",
        "impossibly long",
        "shorter than it is",
        "a long size that is not there",
        "outside of the file",
        "another record",
    ],
)
def test_a_directory_that_lies_about_a_record_is_refused_or_changes_nothing(content, path, policy, offset, value):
    path.write_bytes(patch(content, "archive/data/8", offset, value))
    assert refused_or_unchanged(path, policy) or offset == 20  # nothing depends on how long it is when compressed


def test_records_that_would_be_larger_than_any_policy_are_refused_before_they_are_read(content, path):
    path.write_bytes(patch(pack(records(content)), "archive/data/8", 24, struct.pack("<L", MAX_BYTES + 1)))
    assert "impossibly large" in refusal(path)


@pytest.mark.slow
@pytest.mark.parametrize("compression", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_bomb_is_not_blown_up(content, path, compression):
    target = io.BytesIO(content)
    with zipfile.ZipFile(target, "a", compression) as archive, archive.open("archive/data/99", "w") as record:
        for _ in range(96):
            record.write(bytes(2**20))
    ten = struct.pack("<L", zlib.crc32(bytes(10)))
    bomb = patch(patch(target.getvalue(), "archive/data/99", 16, ten), "archive/data/99", 24, struct.pack("<L", 10))
    path.write_bytes(bomb)
    tracemalloc.start()
    try:
        refusal(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 16 * 2**20


# --- code that would run while the file is loaded


class Awakened(nn.Module):
    """Loaded by TorchScript, it makes a file."""

    def __init__(self, marker: Path) -> None:
        super().__init__()
        self.marker = str(marker)
        self.memory = torch.zeros(1)
        self.training = False

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position + self.memory

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        return joint_position.sum()

    @torch.jit.export
    def __getstate__(self) -> tuple[str, bool]:
        return self.marker, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[str, bool]) -> None:
        self.marker = state[0]
        self.training = state[1]
        self.memory = torch.from_file(state[0], True, 1, dtype=torch.float32)


@pytest.fixture
def marker(tmp_path) -> Path:
    return tmp_path / "awakened"


@pytest.fixture
def awakened(content, marker) -> bytes:
    """A file with the metadata of a policy whose loading makes the marker."""
    evil = save(torch.jit.script(Awakened(marker)), records(content)[METADATA].decode())
    torch.jit.load(io.BytesIO(evil))
    assert marker.exists()  # it does
    marker.unlink()
    return evil


def test_code_that_would_run_while_loading_is_refused_and_does_not_run(awakened, path, marker):
    path.write_bytes(awakened)
    assert "would run code while it is loaded" in refusal(path)
    with pytest.raises(PolicyError, match="would run code"):
        read_metadata(path)
    assert not marker.exists()


def written(records: dict[str, bytes], offset: int) -> tuple[bytes, bytes]:
    """Local records that begin at an offset of the file, and their directory."""
    body = directory = b""
    for name, data in records.items():
        common = struct.pack("<5H3L2H", 20, 0, 0, 0, 0, zlib.crc32(data), len(data), len(data), len(name), 0)
        at = offset + len(body)
        directory += b"PK\1\2" + struct.pack("<H", 20) + common + struct.pack("<3H2L", 0, 0, 0, 0, at) + name.encode()
        body += b"PK\3\4" + common + name.encode() + data
    return body, directory


def end(count: int, size: int, offset: int) -> bytes:
    return struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, count, count, size, offset, 0)


def end64(count: int, size: int, offset: int) -> bytes:
    return struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, size, offset)


def with_another_directory_behind_the_locator(good: dict[str, bytes], evil: dict[str, bytes]) -> bytes:
    """Python reads the zip64 end that lies before the locator, torch the one that the locator names."""
    body, directory = written(evil, 0)
    hidden = body + directory + end64(len(evil), len(directory), len(body))
    locator = struct.pack("<4sLQL", b"PK\6\7", 0, len(body) + len(directory), 1)
    body, directory = written(good, len(hidden))
    seen = body + directory + end64(len(good), len(directory), len(hidden) + len(body))
    return hidden + seen + locator + end(0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF)


def with_another_directory_at_the_offset(good: dict[str, bytes], evil: dict[str, bytes]) -> bytes:
    """Python takes the directory that lies before the end, torch the one at the offset that the end names."""
    body, directory = written(good, 0)
    evil = dict(evil)
    while len(evil) < len(good) - 1:
        evil[f"archive/data/{900 + len(evil)}"] = b""
    longer = len(directory) - len(written(evil, 0)[1]) - 46 - len("archive/data/")
    evil["archive/data/" + "9" * longer] = bytes(len(body) + len(directory))
    hidden, hidden_directory = written(evil, 0)
    assert len(hidden_directory) == len(directory)
    shift = len(hidden_directory) + len(body)  # that Python believes in, for a program that stands before the zip
    body, directory = written(good, len(hidden) + len(hidden_directory) - shift)
    return hidden + hidden_directory + body + directory + end(len(good), len(directory), len(hidden))


@pytest.mark.parametrize("hide", [with_another_directory_behind_the_locator, with_another_directory_at_the_offset])
def test_what_torch_reads_is_what_was_checked(content, awakened, path, marker, hide):
    path.write_bytes(hide(records(content), records(awakened)))
    try:
        policy = load_policy(path)
    except PolicyError:
        refusal(path)
    else:
        assert np.array_equal(
            commands(policy, policy.metadata.golden), policy.metadata.golden["joint_velocity_command"]
        )
    assert not marker.exists()


# --- weights that are too short


@pytest.mark.slow
def test_a_forged_file_with_too_little_data_for_its_weights_is_refused(content, tmp_path):
    good, paths = records(content), []
    for i, size in enumerate([0, 1]):
        for name in ("archive/data/0", "archive/data/3", "archive/data/10"):
            paths.append(tmp_path / f"{len(paths)}.pt")
            paths[i].parent.mkdir(exist_ok=True)
            paths[-1].write_bytes(pack(sign(good | {name: good[name][:size]})))
    said = load_elsewhere(*paths)
    assert [line.partition(":")[0] for line in said] == ["refused"] * len(paths)
