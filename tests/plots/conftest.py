"""Figures that a test can look into."""

import matplotlib.pyplot as plt
import pytest


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were drawn, left open."""
    monkeypatch.setattr(plt, "close", lambda _: None)
    yield plt.gcf
    monkeypatch.undo()
    plt.close("all")
