"""A robot's computer: a venv with torch and numpy, what they require, and physai; nothing else."""

import json
import subprocess
import sys
import sysconfig
import venv
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import physai

ABSENT = ["tensordict", "torchrl", "pybullet", "hydra", "omegaconf", "pydantic", "gymnasium"]


def requirements(*names: str) -> set[str]:
    """These distributions and all that they require here."""
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop().lower().replace("_", "-")
        if name not in found:
            found.add(name)
            needed = [Requirement(text) for text in metadata.requires(name) or []]
            waiting += [r.name for r in needed if r.marker is None or r.marker.evaluate({"extra": ""})]
    return found


@pytest.fixture(scope="module")
def robot_python(tmp_path_factory) -> Path:
    """The interpreter of a venv that links to a few of our packages."""
    folder = tmp_path_factory.mktemp("robot")
    venv.create(folder, with_pip=False, symlinks=True)
    target = Path(sysconfig.get_path("purelib", vars={"base": str(folder), "platbase": str(folder)}))
    for name in requirements("torch", "numpy"):
        for file in metadata.files(name) or []:
            top, link = file.parts[0], target / file.parts[0]
            if top not in ("..", "__pycache__") and not link.exists():
                link.symlink_to(Path(str(metadata.distribution(name).locate_file(top))))
    (target / "physai").symlink_to(Path(physai.__file__).parent)
    return folder / "bin" / "python"


def run(python: Path, program: str, *arguments: str, cwd: Path) -> str:
    done = subprocess.run(
        [python, "-I", "-c", program, *arguments],
        capture_output=True,
        text=True,
        timeout=250,
        cwd=cwd,
        env={"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


LOAD = """
import time, json, sys
from importlib.util import find_spec
start = time.perf_counter()
from physai.deploy import load_policy
imported = time.perf_counter()
policy = load_policy(sys.argv[1], expect_joints=["joint1", "joint2"])
loaded = time.perf_counter()
import numpy as np
golden = policy.metadata.golden
inputs = list(zip(golden["joint_position"], golden["joint_velocity"], golden["goal"]))
same = all(np.array_equal(policy(*x), y) for x, y in zip(inputs, golden["joint_velocity_command"]))
times = []
for i in range(10_000):
    x = inputs[i % len(inputs)]
    before = time.perf_counter()
    command = policy(*x)
    times.append(time.perf_counter() - before)
absent = json.loads(sys.argv[2])
print(json.dumps({
    "importable": [name for name in absent if find_spec(name)],
    "imported": [name for name in absent if name in sys.modules],
    "prefix": sys.prefix,
    "golden_error": policy.golden_error,
    "same": same,
    "import_s": imported - start,
    "load_s": loaded - imported,
    "median_us": float(np.median(times)) * 1e6,
    "worst_us": max(times) * 1e6,
}))
"""


@pytest.mark.slow
def test_with_torch_and_numpy_alone_a_policy_loads_and_gives_the_same_commands(robot_python, exported_run, tmp_path):
    found = json.loads(run(robot_python, LOAD, str(exported_run / "policy.pt"), json.dumps(ABSENT), cwd=tmp_path))
    print({key: round(value, 3) for key, value in found.items() if isinstance(value, float)})
    assert found["prefix"] != sys.prefix
    assert found["importable"] == found["imported"] == []
    assert found["golden_error"] == 0.0
    assert found["same"]
    assert found["median_us"] < 20_000  # one period of 50 Hz: this machine needs a hundredth of it
    assert found["load_s"] < 30


WALK = """
import json, sys
from importlib.util import find_spec
from physai.deploy import ControllerConfig, Goal, Imu, JointState, load_policy, make_controller
policy = load_policy(sys.argv[1])
about = policy.metadata
controller, at, told = make_controller(policy, ControllerConfig(), lambda: 0.0), about.home, []  # on time, however busy
for tick in range(150):
    now = 100.0 + 0.02 * tick
    joints = JointState(about.joints, at, 0.0 * at, now)
    imu = Imu((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.1), now, about.goal.frame)
    command = controller.update(now, joints, Goal((0.5, 0.0, 0.0), about.goal.frame), (), imu)
    if command.value is not None:
        at = command.value
        told.append(at.tolist())
print(json.dumps({"importable": [name for name in json.loads(sys.argv[2]) if find_spec(name)], "told": told,
                  "state": command.state.value}))
"""


@pytest.mark.slow
def test_with_torch_and_numpy_alone_legs_are_told_what_they_are_told_here(robot_python, walking_run, tmp_path):
    arguments = str(walking_run / "policy.pt"), json.dumps(ABSENT)
    there, here = (json.loads(run(python, WALK, *arguments, cwd=tmp_path)) for python in (robot_python, sys.executable))
    assert there["importable"] == []
    assert there["state"] == "active"
    assert len(there["told"]) > 100
    assert there["told"] == here["told"]


REFUSE = """
import sys
from physai.deploy import PolicyError, load_policy, read_metadata
print(read_metadata(sys.argv[1]).robot)
try:
    load_policy(sys.argv[1], sha256="0" * 64)
except PolicyError as error:
    print(error)
"""


@pytest.mark.slow
def test_with_torch_and_numpy_alone_a_wrong_file_is_refused(robot_python, exported_run, tmp_path):
    robot, error = run(robot_python, REFUSE, str(exported_run / "policy.pt"), cwd=tmp_path).splitlines()
    assert robot == "planar_arm"
    assert error.startswith(f"{exported_run / 'policy.pt'}: its SHA-256 is")


def test_the_venv_has_what_torch_requires_and_no_more():
    assert {"torch", "numpy", "filelock", "sympy"} <= requirements("torch", "numpy")
    assert not requirements("torch", "numpy") & {*ABSENT, "gymnasium", "hydra-core"}
    assert Path(sys.prefix).exists()
