"""Tables that nothing cuts off."""

import os
import sys

from rich.console import Console
from rich.table import Table

_WIDE = 250  # columns of a file or a pipe, which a reader can make as wide as they like


def show(*tables: Table) -> None:
    """Print tables: as wide as the terminal, and elsewhere as wide as they are."""
    told = sys.stdout.isatty() or "COLUMNS" in os.environ
    Console(width=None if told else _WIDE).print(*tables)
