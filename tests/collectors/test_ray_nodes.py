"""Ray on two computers: the second one has no checkout, and nothing of physai but what a wheel installs.

The second computer is a mount namespace, in which the checkout is not there. What it costs, a minute, buys the only
sight of what a cluster does: that robots are built from what the wheel holds, and that one may lose a computer.
"""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import sysconfig
import time
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hatchling.builders.wheel import WheelBuilder

from tests.training.processes import all_gone, command_of, descendants
from tests.training.small import SIZES, assert_same_run, command, undisturbed
from tests.waiting import wait_while_runs

pytest.importorskip("ray")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),  # four starts of Ray, two of a training
    pytest.mark.skipif(sys.platform != "linux", reason="a computer is a mount namespace here"),
]

CHECKOUT = Path(__file__).parents[2]
RAY = "from ray.scripts.scripts import main; main()"
OPTIONS = ["--block", "--node-ip-address=127.0.0.1", "--num-cpus=1"]
SECOND = """
mount --bind {packages} {folder}/packages
mount -t tmpfs none {checkout}
cd {folder}
exec {folder}/venv/bin/python -c '{ray}' start {options} --address={address} --temp-dir={sockets}/second
"""


class Computers:
    """A cluster of a head, which is this computer, and a second one that can be switched off and on."""

    def __init__(self, folder: Path, sockets: Path) -> None:
        self._sockets = sockets
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{free.getsockname()[1]}"
        port = self.address.partition(":")[2]
        options = [*OPTIONS, f"--port={port}", f"--temp-dir={sockets / 'head'}", "--include-dashboard=false"]
        self.head = _start([sys.executable, "-c", RAY, "start", "--head", *options], cwd=folder)
        self.folder = folder / "second"
        self.second: subprocess.Popen[str] | None = None
        self._install()

    def _install(self) -> None:
        venv.create(self.folder / "venv", symlinks=True)
        [site] = self.folder.glob("venv/lib/python*/site-packages")
        (self.folder / "packages").mkdir()
        (site / "packages.pth").write_text(f"{self.folder / 'packages'}\n")
        wheel = next(iter(WheelBuilder(str(CHECKOUT)).build(directory=str(self.folder), versions=["standard"])))
        zipfile.ZipFile(wheel).extractall(site)

    def switch_on(self) -> None:
        """Let the second computer join."""
        values = {
            "packages": sysconfig.get_path("purelib"),
            "folder": self.folder,
            "sockets": self._sockets,
            "checkout": CHECKOUT,
            "ray": RAY,
            "options": " ".join(OPTIONS),
            "address": self.address,
        }
        script = SECOND.format(**values)
        self.second = _start(["unshare", "--map-root-user", "--mount", "sh", "-ec", script], cwd=self.folder)

    def switch_off(self) -> None:
        """End the second computer as a power cut does."""
        assert self.second is not None
        _cut_power(self.second)

    def workers(self) -> set[str]:
        """The folders in which its processes step robots."""
        assert self.second is not None
        found = {one for one in descendants(self.second.pid) if "WorkerCollector" in command_of(one)}
        return {os.readlink(f"/proc/{one}/cwd") for one in found}

    def close(self) -> None:
        """Switch both off."""
        for one in (self.head, self.second):
            if one is not None and one.poll() is None:
                _cut_power(one)


def _cut_power(computer: "subprocess.Popen[str]") -> None:
    started = {computer.pid, *descendants(computer.pid)}
    raylets = {process for process in started if "/raylet " in command_of(process)}
    assert raylets
    _kill(raylets)
    time.sleep(1)  # in which what is left of Ray there tells the learner, with the last lines of the raylet's log
    _kill(started - raylets)
    computer.communicate()
    assert all_gone(started)


def _kill(processes: set[int]) -> None:
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)


def _start(program: list[str], cwd: Path) -> "subprocess.Popen[str]":
    process = subprocess.Popen(
        program, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ
    )
    assert process.stdout is not None
    said = []
    for line in process.stdout:
        said.append(line)
        if "Ray runtime started" in line:
            return process
    pytest.fail("".join(said))


@pytest.fixture
def computers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Computers]:
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_worker_niceness", "0")
    with TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as short:  # paths of sockets have 107 bytes
        made = Computers(tmp_path, Path(short))
        yield made
        made.close()


def test_a_run_that_loses_a_computer_ends_in_one_line_and_goes_on_when_it_is_back(computers, once, tmp_path):
    """To the same weights as if nothing had happened."""
    joining = ["collector=ray", f"collector.ray_init.address={computers.address}"]
    computers.switch_on()
    lost = command("train", *joining, *SIZES, "hydra.run.dir=lost", cwd=tmp_path)
    saved = tmp_path / "lost" / "checkpoints"
    wait_while_runs(lost, lambda: len(list(saved.glob("0*.pt"))) >= 2)
    assert computers.workers() == {str(computers.folder)}
    computers.switch_off()
    output = lost.communicate(timeout=120)[0]
    assert lost.returncode == 2, output
    assert [line for line in output.splitlines() if "error" in line.lower()] == [output.splitlines()[-1]]
    assert "a process that collects has ended" in output.splitlines()[-1]
    assert "raylet" not in output.lower()

    computers.switch_on()
    again = command("train", "resume=lost", *joining, cwd=tmp_path)
    output = again.communicate()[0]
    assert again.returncode == 0, output
    assert_same_run(tmp_path / "lost", undisturbed(once, "multi_sync"))
