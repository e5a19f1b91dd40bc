"""Files that are no policy, damaged or hostile: refused in one line, before anything in them is unpickled or run."""

import io
import os
import pickle
import random
import struct
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from physai.deploy import PolicyError, load_policy
from tests.deploy.files import (
    LOAD,
    METADATA,
    load_elsewhere,
    pack,
    records,
    refusal,
    refused_or_unchanged,
    sign,
)

COMPRESSED = 0x08


# --- damage


def places(content: bytes) -> dict[str, list[int]]:
    """All offsets of each part of a policy file."""
    found: dict[str, list[int]] = {"local header": [], "weights": [], "code": [], "metadata": [], "pickle": []}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for entry in archive.infolist():
            name, extra = struct.unpack("<HH", content[entry.header_offset + 26 : entry.header_offset + 30])
            start = entry.header_offset + 30 + name + extra
            found["local header"] += range(entry.header_offset, start)
            kind = {"data": "weights", "code": "code", "extra": "metadata"}.get(entry.filename.split("/")[1], "pickle")
            found[kind] += range(start, start + entry.compress_size)
        found["directory"] = list(range(archive.start_dir, content.rindex(b"PK\5\6")))
    found["end"] = list(range(content.rindex(b"PK\5\6"), len(content)))
    return found


def mutations(content: bytes, seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """Flips, overwritten runs and cuts, as many of each part of the file."""
    rng, parts = random.Random(seed), places(content)
    for i in range(count):
        part = list(parts)[i % len(parts)]
        at = rng.choice(parts[part])
        damaged = bytearray(content)
        how = ("flip", "flip", "flips", "run", "zeros", "cut")[i // len(parts) % 6]
        if how in ("flip", "flips"):
            for place in [at] if how == "flip" else rng.choices(parts[part], k=5):
                damaged[place] ^= 1 << rng.randrange(8)
        elif how == "cut":
            del damaged[at:]
        else:
            size = rng.choice([2, 4, 8, 40])
            damaged[at : at + size] = rng.randbytes(size) if how == "run" else bytes(size)
        yield f"{i}: {how} at {at} ({part})", bytes(damaged)


@pytest.mark.slow
def test_damage_anywhere_is_refused_or_changes_no_bit_of_any_command(content, path, policy):
    refused = 0
    for what, damaged in mutations(content, seed=0, count=350):
        print(what)  # shown if it fails
        path.write_bytes(damaged)
        refused += refused_or_unchanged(path, policy)
    assert 250 < refused < 350  # the others: dates, and checksums that the directory has once more


def test_with_its_hash_beside_every_damage_is_refused(content, path, exported_run):
    path.with_name("policy.pt.sha256").write_bytes((exported_run / "policy.pt.sha256").read_bytes())
    for _, damaged in mutations(content, seed=1, count=200):
        if damaged != content:  # zeros where zeros were
            path.write_bytes(damaged)
            assert any(word in refusal(path) for word in ("SHA-256", "empty"))


def test_a_file_cut_anywhere_is_refused(content, path):
    size = len(content)
    for length in {*range(40), *range(0, size, size // 100), *range(size - 120, size)}:
        path.write_bytes(content[:length])
        refusal(path)


@pytest.mark.parametrize("garbage", [b"\0", b"garbage", b"PK", b"PK\5\6" + bytes(18), b"\n" * 70_000], ids=repr)
def test_garbage_before_or_behind_is_refused_or_changes_nothing(content, path, policy, garbage):
    for damaged in (garbage[:30] + content, content + garbage, b"PK" + garbage + content, content + content):
        path.write_bytes(damaged)
        refused_or_unchanged(path, policy)


# --- other files


class Bomb:
    """Unpickled by Python, it makes a folder."""

    def __init__(self, marker: Path) -> None:
        self.marker = str(marker)

    def __reduce__(self):
        return os.mkdir, (self.marker,)


def saved_by_torch(value: object) -> bytes:
    target = io.BytesIO()
    torch.save(value, target)
    return target.getvalue()


OTHER_FILES = {
    "nothing": (lambda good, bomb: b"", "the file is empty"),
    "text": (lambda good, bomb: b"a policy", "not a TorchScript file"),
    "two bytes of a zip": (lambda good, bomb: b"PK", "the archive is damaged"),
    "noise": (lambda good, bomb: b"PK\3\4" + random.Random(0).randbytes(50_000), "the archive is damaged"),
    "a zip without files": (lambda good, bomb: b"PK\3\4" + pack({}), "the archive is damaged"),
    "another zip": (lambda good, bomb: pack({"readme/a.txt": b"hello"}), "the archive holds 'readme/a.txt'"),
    "a policy in a zip": (lambda good, bomb: pack({"archive/policy.pt": pack(good)}), "holds 'archive/policy.pt'"),
    "a pickle with code": (lambda good, bomb: pickle.dumps(bomb), "not a TorchScript file"),
    "a checkpoint with code": (lambda good, bomb: saved_by_torch(bomb), "the archive holds"),
    "a policy with a pickle's code": (
        lambda good, bomb: pack(sign(good | {"archive/data.pkl": pickle.dumps(bomb)})),
        "cannot be run",
    ),
    "a policy with a pickle's code, unsigned": (
        lambda good, bomb: pack(good | {"archive/data.pkl": pickle.dumps(bomb)}),
        "content_sha256 differs",
    ),
    "constants with a pickle's code": (
        lambda good, bomb: pack(sign(good | {"archive/constants.pkl": pickle.dumps(bomb, protocol=2)})),
        "cannot be run",
    ),
}


@pytest.mark.parametrize("kind", OTHER_FILES)
def test_another_file_is_refused_and_none_of_its_code_runs(content, path, tmp_path, kind):
    make, reason = OTHER_FILES[kind]
    path.write_bytes(make(records(content), Bomb(tmp_path / "exploded")))
    assert reason in refusal(path)
    assert not (tmp_path / "exploded").exists()


def test_an_onnx_file_is_refused(exported_run, path):
    path.write_bytes((exported_run / "policy.onnx").read_bytes())
    assert "not a TorchScript file" in refusal(path)


@pytest.mark.parametrize("record", ["data.pkl", "constants.pkl", "version", "extra/metadata.json"])
def test_a_policy_without_one_of_its_records_is_refused(content, path, record):
    path.write_bytes(pack({name: data for name, data in records(content).items() if name != f"archive/{record}"}))
    assert f"{Path(record).name} is missing" in refusal(path)


@pytest.mark.parametrize(
    "name",
    [
        "archive/../../etc/passwd",
        "archive/code/../../x.py",
        "/archive/data/0",
        "other/data/0",
        "archive/extra/more.json",
        "archive/code/x.so",
        "archive/code/",
        "archive/data/0/1",
        "archive/data/0x",
        "archive",
        "archive/",
        "archive/data.pkl/",
        "archive\\data\\0",
        "archive/DATA.PKL",
        "archive/" + "a" * 60_000,
    ],
    ids=lambda name: name[:30],
)
def test_a_record_that_no_policy_has_is_refused(content, path, name):
    path.write_bytes(pack(records(content) | {name: b""}))
    assert "which no policy has" in refusal(path)


def test_a_strange_name_is_quoted_in_one_printable_line(content, path):
    path.write_bytes(pack(records(content) | {"archive/a\nb\x1b[2J": b""}))
    assert "which no policy has" in refusal(path)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_record_that_is_there_twice_is_refused(content, path):
    target = io.BytesIO(content)
    with zipfile.ZipFile(target, "a") as archive:
        archive.writestr("archive/data.pkl", records(content)["archive/data.pkl"])
    path.write_bytes(target.getvalue())
    assert "which no policy has" in refusal(path)


@pytest.mark.parametrize("text", [b"\xff\xfe{}", b"{\xc3}", b"\x80"])
def test_metadata_that_are_no_utf8_are_refused(content, path, text):
    path.write_bytes(pack(records(content) | {METADATA: text}))
    assert "not UTF-8" in refusal(path)


def test_a_policy_that_was_packed_again_is_the_same_policy(content, path, policy):
    for compression in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        path.write_bytes(pack(records(content), compression))
        assert not refused_or_unchanged(path, policy)


# --- paths


def test_a_missing_file_a_folder_and_a_device_are_named(tmp_path):
    assert "no such file" in refusal(tmp_path / "policy.pt")
    assert "not a file" in refusal(tmp_path)
    assert "not a file" in refusal(Path("/dev/zero"))
    assert "empty" in refusal(Path("/proc/self/status"))  # its size is said to be 0


@pytest.mark.timeout(20)
def test_a_pipe_is_refused_and_not_waited_for(path, content):
    os.mkfifo(path)
    assert "not a file" in refusal(path)
    path.unlink()
    path.write_bytes(content)
    os.mkfifo(path.with_name("policy.pt.sha256"))
    with pytest.raises(PolicyError, match=r"policy\.pt\.sha256: not a file"):
        load_policy(path)


def test_links_are_followed_but_not_for_ever(path, exported_run):
    path.symlink_to(path)
    refusal(path)
    path.unlink()
    path.symlink_to("nowhere")
    assert "no such file" in refusal(path)
    path.unlink()
    path.symlink_to(exported_run / "policy.pt")
    assert load_policy(path).golden_error == 0


def test_a_file_that_is_too_large_is_refused_unread(path):
    with path.open("wb") as file:
        file.truncate(2**40)
    assert "too many for a policy" in refusal(path)


def test_a_path_that_cannot_exist_is_refused(content, tmp_path):
    with pytest.raises(PolicyError):
        load_policy("a\0b")
    refusal(tmp_path / ("a" * 300))


def test_a_policy_with_a_long_name_loads(content, tmp_path):
    path = tmp_path / ("a" * 250)
    path.write_bytes(content)
    assert load_policy(path).golden_error == 0


AS_NOBODY = f"import os\nimport physai.deploy.policy\nif os.geteuid() == 0:\n    os.setuid(65534)\n{LOAD}"


@pytest.mark.slow
def test_a_file_that_may_not_be_read_is_refused(content):
    with tempfile.TemporaryDirectory() as folder:
        secret, locked = Path(folder) / "secret.pt", Path(folder) / "locked" / "policy.pt"
        locked.parent.mkdir()
        for path in (secret, locked):
            path.write_bytes(content)
        Path(folder).chmod(0o755)
        secret.chmod(0)
        locked.parent.chmod(0)
        said = load_elsewhere(secret, locked, program=AS_NOBODY)
        locked.parent.chmod(0o755)
    assert [line.startswith("refused: ") and "cannot be read" in line for line in said] == [True, True]
    assert str(secret) in said[0]
