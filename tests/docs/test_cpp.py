"""docs/examples/drive.cpp, compiled as the page shows: it answers as the Python loader does, and refuses what it must.

It is compiled once, which takes 10 to 15 s. Nothing else shows that a policy file works without Python.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from physai.deploy import Policy, load_policy
from tests.deploy.files import described, pack, records, save, sign
from tests.docs.blocks import ROOT, blocks

PROGRAM = ROOT / "docs" / "examples" / "drive.cpp"
COMPILER = "g++"  # whose block is compiled and run here, and nowhere else
GOOD = "0.1 0.2 0.0 0.0 0.3 0.2"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which(COMPILER) is None, reason=f"{COMPILER} is not installed"),
]


def shell(commands: str, folder: Path) -> str:
    """Run commands as a user does who has activated the virtual environment."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-ec", commands], cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="session")
def built(exported_run: Path, once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """A folder where the page's commands were run: ``drive``, and beside it what they printed, ``output.txt``."""

    def build(folder: Path) -> None:
        (folder / "docs").symlink_to(ROOT / "docs")
        copy(exported_run, folder)
        (block,) = [block for block in blocks("bash") if COMPILER in block.text]
        (folder / "output.txt").write_text(shell(block.text, folder))

    return once("cpp", build)


def copy(run: Path, folder: Path) -> None:
    for name in ("policy.pt", "policy.pt.sha256"):
        shutil.copy(run / name, folder)


@pytest.fixture(scope="session")
def drive(built):
    """Run the program on a policy file and lines; return exit code, answers and errors."""

    def drive(path: Path, text: str, *arguments: str) -> tuple[int, list[str], list[str]]:
        done = subprocess.run(
            [built / "drive", path, *arguments], input=text, capture_output=True, text=True, timeout=60
        )
        return done.returncode, done.stdout.splitlines(), done.stderr.splitlines()

    return drive


def refused(drive, content: bytes, folder: Path) -> str:
    """What the program says of a file that it refuses, although its hash is right: one line, and no command."""
    path = folder / "policy.pt"
    path.write_bytes(content)
    code, answers, (error,) = drive(path, f"{GOOD}\n", hashlib.sha256(content).hexdigest())
    assert (code, answers) == (2, [])
    assert error.startswith(f"error: {path}: ")
    return error.removeprefix(f"error: {path}: ")


def states(policy: Policy, count: int = 100) -> np.ndarray:
    """Inputs within their bounds, side by side, without a memory; [count, numbers]."""
    generator = np.random.default_rng(0)
    bounds = [np.clip(signal.bounds, -4, 4) for signal in policy.metadata.inputs if signal.name != "memory"]
    return np.concatenate([generator.uniform(*each, size=(count, *each[0].shape)) for each in bounds], axis=1)


def lines(rows: np.ndarray) -> str:
    return "".join(f"{' '.join(map(repr, row.tolist()))}\n" for row in rows)


def episode(policy: Policy, rows: np.ndarray) -> list[np.ndarray]:
    """The commands of the Python loader."""
    found, memory = [], np.zeros(policy.metadata.memory_size, np.float32)
    ends = np.cumsum([signal.size for signal in policy.metadata.inputs if signal.name != "memory"])[:-1]
    for row in rows:
        inputs = np.split(row, ends)
        if len(memory):
            command, memory = policy(*inputs, memory)
        else:
            command = policy(*inputs)
        found.append(command.copy())
    return found


def test_the_program_is_as_short_as_the_page_says():
    assert len(PROGRAM.read_text().splitlines()) <= 150
    assert "150 lines" in (ROOT / "docs" / "deploy.md").read_text()


def test_the_page_compiles_it_and_gets_the_command_of_the_python_loader(built, exported_run):
    printed = (built / "output.txt").read_text().split()
    expected = load_policy(exported_run / "policy.pt")([0.1, 0.2], [0.0, 0.0], [0.3, 0.2])
    np.testing.assert_allclose([float(word) for word in printed], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("run", ["exported_run", "position_run", "recurrent_run"])
def test_it_answers_as_the_python_loader_does(run, drive, request):
    path = request.getfixturevalue(run) / "policy.pt"
    policy = load_policy(path)
    rows = states(policy)
    code, answers, errors = drive(path, f"{lines(rows)}start\n{lines(rows[:10])}")
    assert (code, errors) == (0, [])
    expected = episode(policy, rows) + episode(policy, rows[:10])
    np.testing.assert_allclose([list(map(float, answer.split())) for answer in answers], expected, rtol=0, atol=1e-6)


def test_a_policy_that_remembers_answers_otherwise_later_in_an_episode(drive, recurrent_run):
    _, (first, second, anew), _ = drive(recurrent_run / "policy.pt", f"{GOOD}\n{GOOD}\nstart\n{GOOD}\n")
    assert first == anew != second


def test_it_answers_each_line_before_the_next_one_comes(built, exported_run):
    command = [built / "drive", exported_run / "policy.pt"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        for _ in range(3):
            process.stdin.write(f"{GOOD}\n")
            process.stdin.flush()
            assert len(process.stdout.readline().split()) == 2
        process.stdin.close()
        assert process.wait(60) == 0


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("\n", "joint_position needs 2 finite numbers"),
        ("0.1 0.2 0.0\n", "joint_velocity needs 2 finite numbers"),
        ("0.1 0.2 0.0 0.0 0.3\n", "goal needs 2 finite numbers"),
        (f"{GOOD} 0.1\n", "too many numbers"),
        (f"{GOOD}", "no line break"),
        ("0.1 nan 0.0 0.0 0.3 0.2\n", "joint_position needs 2 finite numbers"),
        ("0.1 0.2 0.0 -inf 0.3 0.2\n", "joint_velocity needs 2 finite numbers"),
        ("0.1 0.2 0.0 0.0 0.3 1e39\n", "goal needs 2 finite numbers"),  # more than float32 holds
        ("0.1 0.2 0.0 0.0 0.3 1e999\n", "goal needs 2 finite numbers"),
        ("0,1 0.2 0.0 0.0 0.3 0.2\n", "joint_position needs 2 finite numbers"),
        ("0.1 0.2 0.0 0.0 0.3 0x1\n", "goal needs 2 finite numbers"),
        ("0.1 0.2 0.0 0.0-0.3 0.2 0.1\n", "joint_velocity needs 2 finite numbers"),
        ("0.1 0.2 0.0 0.0 0.3 0.2\0\n", "goal needs 2 finite numbers"),
        ("stop\n", "joint_position needs 2 finite numbers"),
    ],
    ids=repr,
)
def test_a_line_that_is_not_all_numbers_ends_it_without_a_command(line, reason, drive, exported_run):
    code, answers, (error,) = drive(exported_run / "policy.pt", f"{GOOD}\n{line}")
    assert (code, len(answers)) == (2, 1)
    assert error.startswith("error: line 2: ")
    assert reason in error


@pytest.mark.parametrize("place", [0.02, 0.5, 0.98])
def test_a_changed_byte_is_found_by_the_hash_beside_the_file(place, drive, exported_run, tmp_path):
    copy(exported_run, tmp_path)
    content = bytearray((exported_run / "policy.pt").read_bytes())
    content[int(place * len(content))] ^= 1
    (tmp_path / "policy.pt").write_bytes(content)
    code, answers, (error,) = drive(tmp_path / "policy.pt", f"{GOOD}\n")
    assert (code, answers) == (2, [])
    assert "its SHA-256 is not the expected one" in error


def test_no_file_is_taken_without_a_hash(drive, exported_run, tmp_path):
    shutil.copy(exported_run / "policy.pt", tmp_path)
    code, answers, (error,) = drive(tmp_path / "policy.pt", f"{GOOD}\n")
    assert (code, answers, error) == (2, [], f"error: {tmp_path / 'policy.pt'}: there is no .sha256 beside it")
    digest = hashlib.sha256((tmp_path / "policy.pt").read_bytes()).hexdigest()
    assert drive(tmp_path / "policy.pt", f"{GOOD}\n", digest)[0] == 0


@pytest.mark.parametrize("length", [55, 56, 63, 64, 119, 120, 1000])
def test_its_hash_is_that_of_files_of_any_length(length, drive, tmp_path):
    assert "expected" not in refused(drive, b"x" * length, tmp_path)


def test_other_weights_are_found_by_the_golden_pairs(drive, exported_run, tmp_path):
    changed = records((exported_run / "policy.pt").read_bytes())
    name = max((name for name in changed if "/data/" in name), key=lambda name: len(changed[name]))
    weights = np.frombuffer(changed[name], np.float32) * np.float32(1.01)
    reason = refused(drive, pack(sign(changed | {name: weights.tobytes()})), tmp_path)
    assert reason == "it does not give the joint_velocity_command that it gave when it was exported"


def test_another_golden_pair_is_found(drive, exported_run, tmp_path):
    def change(metadata):
        metadata["golden"]["joint_velocity_command"][-1][1] += 2e-4

    content = described((exported_run / "policy.pt").read_bytes(), change)
    assert "it does not give the joint_velocity_command" in refused(drive, content, tmp_path)


def test_an_older_format_is_refused(drive, exported_run, tmp_path):
    content = described((exported_run / "policy.pt").read_bytes(), lambda metadata: metadata.update(format_version=3))
    assert refused(drive, content, tmp_path) == "not a policy of format 4"


def test_a_module_that_is_no_policy_is_refused(drive, tmp_path):
    content = save(torch.jit.script(torch.nn.Linear(2, 2).eval()))
    assert refused(drive, content, tmp_path) == "not a policy of format 4"


def test_a_file_that_is_no_archive_is_refused(drive, tmp_path):
    assert refused(drive, b"no archive", tmp_path) == "not a TorchScript file"


def test_half_an_archive_is_refused(drive, exported_run, tmp_path):
    content = (exported_run / "policy.pt").read_bytes()
    assert refused(drive, content[: len(content) // 2], tmp_path)


def test_a_missing_file_is_named(drive, tmp_path):
    _, _, (error,) = drive(tmp_path / "none.pt", "")
    assert error == f"error: {tmp_path / 'none.pt'}: the file is missing or empty"
