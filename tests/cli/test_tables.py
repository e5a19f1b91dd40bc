"""Tables in a terminal, in a pipe, and in a file."""

import pytest
from rich.table import Table

from physai.cli.tables import show


@pytest.mark.parametrize(("columns", "whole"), [(None, True), ("", True), ("60", False)])
def test_a_table_that_nobody_s_terminal_limits_is_shown_whole(monkeypatch, capsys, columns, whole):
    monkeypatch.delenv("COLUMNS", raising=False)
    if columns is not None:
        monkeypatch.setenv("COLUMNS", columns)
    words = [f"what-the-column-{number}-says" for number in range(20)]  # 500 columns
    table = Table(*words)
    table.add_row(*words)
    show(table)
    said = capsys.readouterr().out
    assert all(said.count(word) == 2 for word in words) == whole
