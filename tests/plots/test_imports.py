"""What pictures are made with is imported when one is drawn, and a drive is drawn without ROS."""

import subprocess
import sys

import pytest


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "absent"),
    [("physai.plots", ["matplotlib", "pandas", "torch"]), ("physai.plots.drive", ["rclpy", "pandas"])],
)
def test_pictures_import_what_they_need_and_no_more(module, absent):
    code = f"import sys, {module}; print(sorted({set(absent)!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
