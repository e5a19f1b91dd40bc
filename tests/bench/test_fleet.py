"""The measurement of a fleet runs, and shows every figure."""

import os
import subprocess
import sys

import numpy as np
import pytest
from rich.console import Console

from physai.bench.fleet import FleetFigures, fleet_table
from tests.ros.peer import free_domain

SCRIPT = """
import shutil, sys
from physai.bench import fleet

def copy_run(run, *_):
    shutil.copytree(sys.argv[1], run, dirs_exist_ok=True)

fleet.ARMS, fleet.TRIALS, fleet.DRIVE_SECONDS, fleet.make_run = 1, 2, 2.0, copy_run
if __name__ == "__main__":
    figures = fleet.measure_fleet(0)
    print("measured", figures.zeros.shape, bool((figures.zeros > 0).all()), len(figures.periods) > 50)
"""


@pytest.mark.realtime
def test_an_arm_is_driven_and_stopped(exported_run, tmp_path):
    """Half a minute, in a process of its own, which forks the nodes."""
    (tmp_path / "measure.py").write_text(SCRIPT)
    with free_domain() as domain:
        env = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [sys.executable, str(tmp_path / "measure.py"), str(exported_run)]
        ran = subprocess.run(command, env=env, capture_output=True, text=True, timeout=240)
    assert "measured (2, 1) True True" in ran.stdout, ran.stdout + ran.stderr


def test_the_table_counts_the_trials_in_which_a_robot_was_late():
    zeros = np.array([[0.001, 0.049], [0.002, 0.051], [np.nan, 0.001]])
    console = Console(width=150, record=True)
    console.print(fleet_table(FleetFigures(zeros, np.full(100, 0.02))))
    shown = console.export_text()
    assert "2 virtual arms; stopped 3 times, 2 times not all of them within 50 ms" in shown
    assert "20.00" in shown
