"""The policy file as an archive: what its zip must look like before anything in it is unpickled or run."""

import hashlib
import io
import re
import zipfile
from pathlib import Path
from typing import NamedTuple

from physai.deploy.reading import PolicyError

METADATA = "metadata.json"  # its name among TorchScript's extra files and among ONNX's metadata_props
MAX_BYTES = 64 * 2**20
_RECORD = re.compile(
    r"(data\.pkl|constants\.pkl|version|byteorder|\.data/serialization_id"
    r"|(data|constants)/\d+|code/[\w/]+\.py|extra/metadata\.json)"
)


class Archive(NamedTuple):
    """A policy file whose structure is sound.

    Attributes:
        content: The checked records as an archive of their own: what may be loaded.
        metadata: Its metadata, not yet parsed.
        content_sha256: Hash of code, weights and constants: of all that ``torch.jit.load`` reads.
    """

    content: bytes
    metadata: str
    content_sha256: str


def read(path: Path) -> bytes:
    """Read a file of a plausible size.

    Raises:
        PolicyError: If it cannot be a policy, and why.
    """
    try:
        if not path.is_file():  # a folder; a pipe, which would be read for ever
            raise PolicyError(f"{path}: no such file" if not path.exists() else f"{path}: not a file")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise PolicyError(f"{path}: {size:,} bytes are too many for a policy, which has {MAX_BYTES:,} at most")
        if size == 0:
            raise PolicyError(f"{path}: the file is empty")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise PolicyError(f"{path}: cannot be read ({error})") from error


def check(path: Path, content: bytes) -> Archive:
    """Check the structure of a policy file without unpickling or running any of it.

    Every record must be one that TorchScript writes, whole and with the right checksum; code that would run while the
    file is being loaded (``__setstate__``) is refused.

    Raises:
        PolicyError: If it is not the archive of a policy, and why.
    """
    try:
        records = _records(content)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    except Exception as error:  # whatever zipfile makes of hostile bytes
        raise PolicyError(f"{path}: the archive is damaged ({_line(error)})") from error
    for needed in ("data.pkl", "constants.pkl", "version"):
        if needed not in records:
            raise PolicyError(f"{path}: not a TorchScript file ({needed} is missing)")
    if f"extra/{METADATA}" not in records:
        raise PolicyError(f"{path}: a TorchScript file, but no physai policy ({METADATA} is missing)")
    try:
        metadata = records[f"extra/{METADATA}"].decode()
    except UnicodeDecodeError as error:
        raise PolicyError(f"{path}: {METADATA} is not UTF-8") from error
    return Archive(_rewritten(records), metadata, _digest(records))


def tensor_sizes(content: bytes) -> list[int]:
    """Bytes of each tensor's record in a sound file."""
    return [len(data) for name, data in _records(content).items() if name.startswith("data/")]


def content_sha256(content: bytes) -> str:
    """Hash of all that ``torch.jit.load`` reads of a TorchScript file, with metadata or without."""
    return _digest(_records(content))


def _records(content: bytes) -> dict[str, bytes]:
    if content[:2] != b"PK":
        raise PolicyError("not a TorchScript file")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = archive.infolist()
        root = entries[0].filename.partition("/")[0] if entries else ""
        if not root or sum(entry.file_size for entry in entries) > MAX_BYTES:
            raise PolicyError("the archive is damaged (empty, or its records are impossibly large)")
        records: dict[str, bytes] = {}
        for entry in entries:
            folder, _, name = entry.filename.partition("/")
            if folder != root or name in records or not _RECORD.fullmatch(name):
                raise PolicyError(f"the archive holds '{entry.filename[:80]}', which no policy has")
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise PolicyError(f"'{entry.filename}' is compressed in a way that no policy is")
            with archive.open(entry) as record:  # raises if the checksum is wrong
                records[name] = record.read(entry.file_size + 1)  # without a size, up to 1 GiB would be decompressed
            if len(records[name]) != entry.file_size:
                raise PolicyError(f"'{entry.filename}' is not as long as the archive says")
            if name.endswith(".py") and b"__setstate__" in records[name]:
                raise PolicyError(f"'{entry.filename}' would run code while it is loaded")
    return records


def _rewritten(records: dict[str, bytes]) -> bytes:
    """These records and nothing else: a file can be made such that torch finds others in it than Python does."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in records.items():
            archive.writestr(f"archive/{name}", data)
    return target.getvalue()


def _digest(records: dict[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name in sorted(records):
        if not name.startswith(("extra/", ".data/")):
            digest.update(f"{name} {len(records[name])}\n".encode())
            digest.update(records[name])
    return digest.hexdigest()


def _line(error: Exception) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:80]
