"""Files that are whole or not there, whatever happens to the program or the computer."""

import os
from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file; whatever happens, ``path`` holds either the old content or the new.

    Args:
        path: The file; its folder is made, with its parents.
        content: All that it is to hold.

    Raises:
        OSError: If the disk refuses.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.unlink(missing_ok=True)  # of a write that was killed; or a link, which would be written through
    try:
        with open(temporary, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the names of the files in a folder, too.

    Raises:
        OSError: If the disk refuses.
    """
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
