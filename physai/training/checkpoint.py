"""Checkpoints: whole after a kill, too, and read without running code."""

import io
from pathlib import Path
from typing import Any

import torch

from physai.errors import UserError
from physai.files import write_atomically

_FORMAT = 5


def save(path: Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values, as safely as :func:`physai.files.write_atomically`."""
    buffer = io.BytesIO()
    torch.save({"format": _FORMAT, **content}, buffer)
    write_atomically(path, buffer.getvalue())


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint; code in the file is not run.

    Raises:
        UserError: If the file is missing, damaged, or of another format.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such checkpoint") from error
    except Exception as error:  # whatever torch makes of a file that it did not write
        reason = (str(error) or type(error).__name__).splitlines()[0][:80]
        raise UserError(f"{path}: the checkpoint is damaged ({reason})") from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise UserError(f"{path}: not a checkpoint of this version of physai")
    return content


class CheckpointFolder:
    """The last few checkpoints of a run, by frames, and the best policy.

    Args:
        folder: Where they lie.
        keep: How many to keep, apart from the best policy.
    """

    def __init__(self, folder: Path, keep: int) -> None:
        self.folder = folder
        self.keep = keep

    @property
    def best(self) -> Path:
        """The best policy so far."""
        return self.folder / "best.pt"

    def paths(self) -> list[Path]:
        """All checkpoints, oldest first."""
        return sorted(path for path in self.folder.glob("*.pt") if path.stem.isdigit())

    def find(self, which: str) -> Path:
        """Return the file of ``best``, ``last``, or a number of frames.

        Raises:
            UserError: If there is none.
        """
        paths = self.paths()
        if which == "best" and self.best.is_file():
            return self.best
        if which == "last" and paths:
            return paths[-1]
        for path in paths:
            if which.isdigit() and int(path.stem) == int(which):
                return path
        have = ", ".join([*(["best"] if self.best.is_file() else []), *(str(int(path.stem)) for path in paths)])
        raise UserError(f"{self.folder}: no checkpoint '{which}'; there are: {have or 'none'}")

    def save(self, frames: int, content: dict[str, Any]) -> Path:
        """Save the checkpoint of so many frames, then drop the oldest beyond ``keep``."""
        path = self.folder / f"{frames:012d}.pt"
        save(path, content)
        for old in self.paths()[: -self.keep]:
            old.unlink()
        return path
