"""The measurement of a fleet runs, and shows every figure."""

import os
import subprocess
import sys

import numpy as np
import pytest
from rich.console import Console

from physai.bench.fleet import FleetFigures, fleet_table
from physai.bench.onlooker import ages
from tests.ros.peer import free_domain

SCRIPT = """
import shutil, sys
import numpy as np
from physai.bench import fleet

def copy_run(run, *_):
    shutil.copytree(sys.argv[1], run, dirs_exist_ok=True)

fleet.ARMS, fleet.TRIALS, fleet.DRIVE_SECONDS, fleet.make_run = 1, 2, 2.0, copy_run
if __name__ == "__main__":
    figures = fleet.measure_fleet(0)
    driven = all(len(periods) > 50 for periods in figures.periods)
    print("measured", figures.zeros.shape, bool((figures.zeros > 0).all()), driven, sorted(figures.cpu))
    print("median age", np.median(figures.ages))
"""


@pytest.mark.realtime
def test_an_arm_is_driven_and_stopped(exported_run, tmp_path):
    """Half a minute, in a process of its own, which forks the nodes."""
    (tmp_path / "measure.py").write_text(SCRIPT)
    with free_domain() as domain:
        env = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [sys.executable, str(tmp_path / "measure.py"), str(exported_run)]
        ran = subprocess.run(command, env=env, capture_output=True, text=True, timeout=240)
    parts = ["inference nodes", "page", "this benchmark", "virtual robots", "watchdogs"]
    assert f"measured (2, 1) True True {parts}" in ran.stdout, ran.stdout + ran.stderr
    assert 0.005 < float(ran.stdout.split("median age")[1]) < 0.5


def test_the_table_counts_the_trials_in_which_a_robot_was_late():
    zeros = np.array([[0.001, 0.049], [0.002, 0.051], [np.nan, 0.001]])
    console, period = Console(width=150, record=True), np.full(100, 0.02)
    console.print(fleet_table(FleetFigures(zeros, (period, period), period, {"dashboard": 0.1})))
    shown = console.export_text()
    assert "2 virtual arms; stopped 3 times, 2 times not all of them within 50 ms" in shown
    assert "20.00" in shown
    assert "share of a core: dashboard 10%" in shown


def test_what_the_page_shows_is_as_old_as_the_last_joint_state_that_looks_like_it():
    told = np.array([[1e9, 0.1], [2e9, 0.2], [3e9, 0.2], [4e9, 0.3]])
    shown = np.array([[1.5e9, 0.1], [3.5e9, 0.2 - 2 * np.pi]])
    moments = [int(second * 1e9) for second in (1.2, 1.6, 2.5, 3.6, 4.5)]
    assert ages(shown, told, moments) == pytest.approx([0.2, 0.6, 1.5, 0.6, 1.5])
