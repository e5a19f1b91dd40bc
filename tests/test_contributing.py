"""The examples of CONTRIBUTING.md and of docs/walk.md, followed to the letter in a copy of the project."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT, shown_files


@pytest.fixture(scope="module")
def examples() -> dict[str, str]:
    """What these pages show, by the file that it belongs into."""
    return shown_files("CONTRIBUTING.md") | shown_files("docs/walk.md")


@pytest.fixture(scope="module")
def project(tmp_path_factory, examples) -> Path:
    """A copy of the project with all examples in it, and nothing else changed."""
    copy = tmp_path_factory.mktemp("contributed")
    for name in ("physai", "conf", "tests"):
        # With what Python has compiled already, but for files that another worker is about to write.
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("*.pyc.*"))
    shutil.copy(ROOT / "pyproject.toml", copy)
    for path, text in examples.items():
        assert not (copy / path).exists(), f"{path} is there already"
        (copy / path).write_text(text)
    return copy


def run(project: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=project, capture_output=True, text=True, timeout=240)


def test_there_is_an_example_of_everything(examples):
    assert {str(Path(path).parent) for path in examples} == {
        "physai/robots/assets",
        "physai/tasks",
        "conf/robot",
        "conf/env",
        "conf/algo",
        "conf/training",
    }


@pytest.mark.slow
def test_the_discovery_tests_pick_up_what_is_added(project):
    names = ("long_arm", "long_reacher", "joint_reach", "reuse", "mini_cheetah")
    added = f"({' or '.join(names)}) and not impulse and not servo"  # one engine will do
    tests = ("tests/test_config.py", "tests/robots", "tests/tasks", "tests/physics")
    result = run(project, "-m", "pytest", "-vv", "-p", "no:cacheprovider", "-k", added, *tests)
    assert result.returncode == 0, result.stdout
    for name in (
        "robot@env.robot=long_arm",
        "env=long_reacher",
        "env=joint_reach",
        "algo=reuse",
        "env=mini_cheetah_walk",
    ):
        assert re.search(rf"test_every_choice_builds_and_collects\[{re.escape(name)}\] PASSED", result.stdout), name
    assert "test_kinematics.py" in result.stdout  # robots are also held against PyBullet


@pytest.mark.slow
def test_all_of_it_trains_together(project):
    tiny = ("total_frames=2048", "collector.num_envs=64", "evaluation.goals=8", "evaluation.episodes=8")
    tiny += ("evaluation.in_a_row=0", "env.task.max_steps=30", "export.formats=[torchscript]")
    choice = ("algo=reuse", "env=joint_reach", "robot@env.robot=long_arm")
    result = run(project, "-m", "physai.train", *choice, *tiny, "hydra.run.dir=run")
    assert result.returncode == 0, result.stdout + result.stderr
    assert (project / "run" / "policy.pt").is_file()


@pytest.mark.slow
def test_another_robot_on_legs_trains_and_none_falls(project):
    tiny = ("total_frames=12_288", "evaluation.goals=8", "evaluation.episodes=16", "env.task.max_steps=150")
    choice = ("env=mini_cheetah_walk", "physics=mujoco", "export.formats=[]")
    result = run(project, "-m", "physai.train", *choice, *tiny, "hydra.run.dir=legs")
    assert result.returncode == 0, result.stdout + result.stderr
    summary = json.loads((project / "legs" / "summary.json").read_text())
    assert summary["crashed_rate"] == 0
