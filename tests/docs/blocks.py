"""Code blocks of the README, CONTRIBUTING.md and the pages in docs/."""

import re
import shlex
import textwrap
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PAGES = sorted((ROOT / "docs").rglob("*.md"))
FILES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]

_FENCE = re.compile(r"^( *)```(\S*)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)


_FILE = re.compile(r"^`(\S+/\S+)`:\n\n```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """One fenced block.

    Attributes:
        page: Path from the project's root.
        line: Of its fence.
        language: Behind the fence.
        text: What is shown, without indentation.
    """

    page: str
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(language: str | None = None) -> list[Block]:
    """All blocks, or those of one language."""
    found = []
    for path in FILES:
        text = path.read_text()
        for match in _FENCE.finditer(text):
            line = text.count("\n", 0, match.start()) + 1
            shown = textwrap.dedent(match[3])
            found.append(Block(path.relative_to(ROOT).as_posix(), line, match[2], shown))
    return [block for block in found if language in (None, block.language)]


def shown_files(page: str) -> dict[str, str]:
    """The files that a page shows whole, by the path that it names before each."""
    return {match[1]: match[2] for match in _FILE.finditer((ROOT / page).read_text())}


def commands(text: str) -> list[list[str]]:
    """Commands of a bash block as words, without comments; ``<run>`` and the like stand for a name."""
    text = text.replace("$(ros2 pkg prefix physai)", "prefix")
    text = re.sub(r"<(\w+)>", r"\1", re.sub(r"\\\n", " ", text))
    return [words for line in text.splitlines() if (words := shlex.split(line, comments=True))]


def prose(path: Path) -> str:
    """A page without its code blocks."""
    return _FENCE.sub("", path.read_text())


def hooks() -> dict[str, object]:
    """Names of docs/hooks.py, which is no package."""
    import runpy

    return runpy.run_path(str(ROOT / "docs" / "hooks.py"))
