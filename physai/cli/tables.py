"""Tables that a file or a pipe does not cut."""

import os
import sys

from rich.console import Console
from rich.table import Table

_WIDE = 10_000  # columns, more than any table has


def show(*tables: Table) -> None:
    """Print tables: as wide as the terminal, and elsewhere as wide as they are."""
    told = sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdigit()
    Console(width=None if told else _WIDE).print(*tables)
