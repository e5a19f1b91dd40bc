"""The measurement of the ROS 2 node runs, and shows every figure."""

import shutil

import pytest
from rich.console import Console

from physai.bench import ros
from tests.ros.peer import free_domain


@pytest.mark.realtime
def test_both_nodes_are_timed_and_shown(exported_run, monkeypatch):
    monkeypatch.setattr(ros, "make_run", lambda run, *_: shutil.copytree(exported_run, run, dirs_exist_ok=True))
    monkeypatch.setattr(ros, "PERIOD_SECONDS", 2.0)
    monkeypatch.setattr(ros, "LATENCY_SECONDS", 1.0)
    monkeypatch.setattr(ros, "STARTS", 1)
    with free_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        figures = ros.measure_ros(seed=0)
    for node in figures.values():
        assert 60 < len(node.periods) < 120  # other tests run beside it
        assert node.periods.mean() == pytest.approx(0.02, rel=0.2)
        assert 40 < len(node.latencies) < 110
        assert (node.latencies > 0).all()
        assert 0 < node.cpu < 1
        assert len(node.starts) == 1
    console = Console(width=120, record=True)
    console.print(ros.ros_table(figures))
    shown = console.export_text()
    for part in ("p99", "ms", "load of a core", "start to first message"):
        assert part in shown
