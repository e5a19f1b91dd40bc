"""A recording, as a rosbag2 folder with MCAP storage: readable after a kill, too. No ROS in here."""

import contextlib
import fcntl
import os
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

from rosbags.interfaces import Connection, ConnectionExtRosbag2, Qos
from rosbags.rosbag2 import Reader, ReaderError, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapReader, McapWriter
from rosbags.typesys import Stores, get_typestore

from physai.errors import UserError

TYPES = get_typestore(Stores.ROS2_JAZZY)
"""The message types that can be recorded."""

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _CHUNK, _MESSAGE_INDEX, _DATA_END, _FOOTER = 0x01, 0x06, 0x07, 0x0F, 0x02  # records of an MCAP file
_END = struct.pack("<BQI", _DATA_END, 4, 0) + struct.pack("<BQQQI", _FOOTER, 20, 0, 0, 0) + _MAGIC


class Bag:
    """Writes a recording.

    What has been flushed outlives the program, as whole chunks in a file whose end is missing: see :func:`recover`.

    Args:
        folder: Is made, with its parents.

    Attributes:
        connections: Topics, with the types of their messages, that there is place for.
        counts: Messages written, by topic.
        size: Bytes of messages written.

    Raises:
        UserError: If the folder exists or cannot be made; also from all methods, when the disk is full.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.counts: Counter[str] = Counter()
        self.size = 0
        self.connections: dict[tuple[str, str], Connection] = {}
        if folder.exists():
            raise UserError(f"{folder} exists already")
        with _clearly(folder):
            self._writer = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
            fcntl.flock(self._storage.bio, fcntl.LOCK_EX)  # against a recovery of what is not dead
            self._storage.bio.flush()

    @property
    def _storage(self) -> McapWriter:
        return cast(McapWriter, self._writer.storage)

    def add(self, topic: str, kind: str, offered: Sequence[Qos] = ()) -> None:
        """Make place for messages of a type in :data:`TYPES`."""
        self.connections[topic, kind] = self._writer.add_connection(
            topic, kind, typestore=TYPES, offered_qos_profiles=offered
        )

    def write(self, topic: str, kind: str, stamp: int, data: bytes) -> None:
        """Write a message: the time at which it came, ns, and its CDR, as the wire has it."""
        with _clearly(self.folder):
            self._writer.write(self.connections[topic, kind], stamp, data)
        self.counts[topic] += 1
        self.size += len(data)

    def flush(self) -> None:
        """Hand everything to the operating system, so that a kill no longer loses it."""
        with _clearly(self.folder):
            if self._storage.chunk.bio.tell():
                self._storage.close_chunk()
                self._storage.bio.flush()

    def close(self) -> None:
        """Write index and metadata.yaml."""
        with _clearly(self.folder):
            self._writer.close()


def recover(folder: Path) -> int:
    """Complete a recording whose program was killed: index and metadata.yaml for all that had been flushed.

    Returns:
        How many messages it holds.

    Raises:
        UserError: If there is nothing to recover, or no room for a second copy.
    """
    if (folder / "metadata.yaml").exists():
        raise UserError(f"{folder} is complete")
    files = sorted(folder.glob("*.mcap"))
    if len(files) != 1:
        raise UserError(f"{folder} holds no recording")
    with _clearly(folder), TemporaryDirectory(dir=folder) as temporary:
        torn, whole, bag = files[0], Path(temporary) / "whole.mcap", Path(temporary) / files[0].stem
        _copy_whole_records(torn, whole)
        with Reader(whole) as reader:
            copy = Bag(bag)
            for old in reader.connections:
                copy.add(old.topic, old.msgtype, cast(ConnectionExtRosbag2, old.ext).offered_qos_profiles)
            # Without an index, Reader.messages insists on their order, which several topics need not have.
            for old, stamp, data in cast(McapReader, reader.storage).messages_scan(reader.connections):
                copy.write(old.topic, old.msgtype, stamp, data)
            copy.close()
        os.replace(bag / torn.name, torn)
        os.replace(bag / "metadata.yaml", folder / "metadata.yaml")  # last: it says that the rest is done
    return copy.counts.total()


def _copy_whole_records(torn: Path, whole: Path) -> None:
    with torn.open("rb") as source, whole.open("wb") as target:
        try:
            fcntl.flock(source, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UserError(f"{torn.parent} is still being recorded") from error
        size = os.fstat(source.fileno()).st_size
        target.write(source.read(len(_MAGIC)))
        while len(head := source.read(9)) == 9:
            kind, length = struct.unpack("<BQ", head)
            if kind not in (_HEADER, _CHUNK, _MESSAGE_INDEX) or source.tell() + length > size:
                break
            target.write(head + source.read(length))
        target.write(_END)


@contextlib.contextmanager
def _clearly(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"{folder}: {error.strerror}") from error
    except (ReaderError, WriterError) as error:
        raise UserError(f"{folder}: {error}") from error
