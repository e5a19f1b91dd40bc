"""What tests share: one thread, the environments that physai comes with, and runs that are made once."""

import gc
import os
import runpy
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

# Workers of pytest have a core each. Libraries read this when they are imported, also in processes that tests start.
for library in ("OMP", "MKL", "OPENBLAS"):
    os.environ[f"{library}_NUM_THREADS"] = "1"

from tests.forge import close_forge, forge, share_forge

# Started first, it imports side by side with this process, which needs it for its workers.
if "PYTEST_XDIST_WORKER" not in os.environ and any(one.startswith(("-n", "--numprocesses")) for one in sys.argv):
    forge()

gc.disable()  # until all is imported: what that makes stays, and looking for garbage in it takes a quarter longer

import pytest
import torch
from filelock import FileLock
from hydra.core.global_hydra import GlobalHydra
from hypothesis import HealthCheck, settings
from omegaconf import OmegaConf

from physai.compose import conf_dir
from physai.config import validate
from physai.deploy import Policy, load_policy
from physai.envs.simulation import EnvConfig
from physai.training.config import TrainConfig
from physai.training.run import load_config, run_training
from tests import composed
from tests.training.small import SMALL, TINY, command, run_here

# A shell that starts the tests in the background has them, and whatever they start, take no notice of Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine is no fault of a test: how long an example takes says nothing.
settings.register_profile("physai", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("physai")


def pytest_addoption(parser: pytest.Parser) -> None:
    # An option of its own: of two -m, which a user may have given too, only the last counts.
    parser.addoption(
        "--realtime", choices=("only", "without"), help="choose by what measures time (the marker realtime)"
    )


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput"):
        share_forge(config.workerinput["forge"])
    config.add_cleanup(close_forge)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(specs: Sequence[Any]) -> None:
    worker = Path(__file__).with_name("worker.py")
    for spec in specs:
        if not spec.popen or spec.python:
            continue  # another computer, or another Python
        spec.python = shlex.join([sys.executable, "-I", "-S", str(worker), forge().path])


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    node.workerinput["forge"] = forge().path


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    made = {"panda_run", "position_run", "recurrent_run", "small_run", "walking_run"}
    for item in items:
        asked = [*getattr(item, "fixturenames", ())]
        asked += getattr(getattr(item, "callspec", None), "params", {}).values()  # to be got by name
        # A run of their own is made for them; or they run apart.
        if any(name in made for name in asked if isinstance(name, str)) or item.get_closest_marker("realtime"):
            item.add_marker(pytest.mark.slow)
    if (chosen := config.getoption("--realtime")) is None:
        return
    wanted = [item for item in items if (item.get_closest_marker("realtime") is not None) == (chosen == "only")]
    config.hook.pytest_deselected(items=[item for item in items if item not in wanted])
    items[:] = wanted


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run a command in this process, in an empty folder; return exit code, standard output and error."""

    def run(module, *arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [f"physai.{module}", *arguments])
        monkeypatch.setenv("COLUMNS", "200")
        GlobalHydra.instance().clear()
        for name in (f"physai.{module}", f"physai.{module}.__main__"):
            monkeypatch.delitem(sys.modules, name, raising=False)  # no second copy of it
        try:
            runpy.run_module(f"physai.{module}", run_name="__main__")
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        return code, *capsys.readouterr()

    return run


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def env_config() -> Callable[..., EnvConfig]:
    """Compose the config of an env by name: ``env_config("reacher", "env.task.max_steps=5")``."""
    return composed.env_config


@pytest.fixture(scope="session")
def reacher() -> EnvConfig:
    return composed.env_config("reacher")


_ENVS = sorted(path.stem for path in (conf_dir() / "env").glob("*.yaml"))  # what is added there is tested, too
_SIMULATED_ENVS = [name for name in _ENVS if composed.env_config(name).simulated]


@pytest.fixture(scope="session")
def kuka_reacher() -> EnvConfig:
    return composed.env_config("kuka_reacher")


@pytest.fixture(scope="session", params=["reacher", "kuka_reacher"])
def two_joint_env(request: pytest.FixtureRequest) -> EnvConfig:
    """The environments whose arm drives two joints, in turn."""
    return composed.env_config(request.param)


def _first_of_each_robot(floats: bool) -> list[str]:
    configs = {name: composed.env_config(name).robot for name in reversed(_SIMULATED_ENVS)}
    robots = {robot.name: name for name, robot in configs.items() if (robot.floating is not None) == floats}
    return sorted(robots.values())


@pytest.fixture(scope="session", params=_first_of_each_robot(floats=False))
def any_arm(request: pytest.FixtureRequest) -> EnvConfig:
    """An environment of each robot whose base is fixed, in turn."""
    return composed.env_config(request.param)


@pytest.fixture(scope="session", params=_first_of_each_robot(floats=True))
def any_legged(request: pytest.FixtureRequest) -> EnvConfig:
    """An environment of each robot whose base floats, in turn."""
    return composed.env_config(request.param)


@pytest.fixture(scope="session", params=_SIMULATED_ENVS)
def any_env(request: pytest.FixtureRequest) -> EnvConfig:
    """Each environment in turn."""
    return composed.env_config(request.param)


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Callable[[str, Callable[[Path], None]], Path]:
    """Fill a folder once for all workers, and return it: ``once(name, fill)``; not to be written to afterwards.

    Sessions that follow each other share them in the folder PHYSAI_TEST_RUNS, where there is one.
    """
    base = tmp_path_factory.getbasetemp()
    shared = Path(os.environ.get("PHYSAI_TEST_RUNS") or (base if worker_id == "master" else base.parent))

    def once(name: str, fill: Callable[[Path], None]) -> Path:
        folder, done = shared / name, shared / f"{name}.done"
        with FileLock(shared / f"{name}.lock"):  # one of them works, the others wait
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of one that failed
                folder.mkdir()
                fill(folder)
                done.touch()
        return folder

    return once


@pytest.fixture(scope="session")
def exported_run(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """A run of the reacher that reaches most goals, with policy.pt, policy.onnx, and what the export said, export.txt.

    It is not to be written to.
    """
    return once("exported_run", partial(_train_and_export, "total_frames=80_000"))


@pytest.fixture(scope="session")
def position_run(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """The same, of an arm that is driven by joint positions, without policy.onnx."""
    overrides = ("env.robot.command=joint_position", "total_frames=100_000")
    return once("position_run", partial(_train_and_export, *overrides, formats=["torchscript"]))


@pytest.fixture(scope="session")
def recurrent_run(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """A run as ``exported_run`` is, of a policy that remembers."""
    return once("recurrent_run", partial(_train_and_export, "policy=gru", "total_frames=80_000"))


@pytest.fixture(scope="session")
def teacher_run(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """The shortest run of a policy that sees the robot's parameters; a second, for what needs a teacher."""
    tiny = (*TINY, "policy=privileged", "randomization=strong", "collector=single")
    return once("teacher_run", lambda at: run_here(at / "run", *tiny)) / "run"


@pytest.fixture(scope="session")
def panda_run(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """A run of a Panda whose goals are positions in space."""
    overrides = ("env=panda_reach", "physics=mujoco", "total_frames=320_000", "evaluation.every_frames=160_000")
    return once("panda_run", partial(_train_and_export, *overrides))


@pytest.fixture(scope="session")
def walking_run(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """A run of a robot on legs, without policy.onnx; short, for it walks from the first frame on."""
    overrides = (
        "env=a1_walk",
        "physics=mujoco",
        "total_frames=12_288",
        "env.task.max_steps=100",
        "evaluation.goals=20",
        "evaluation.episodes=40",
    )
    return once("walking_run", partial(_train_and_export, *overrides, formats=["torchscript"]))


@pytest.fixture(scope="session")
def walking_policy(walking_run: Path) -> Policy:
    """Its policy: loaded once, not to be changed."""
    return load_policy(walking_run / "policy.pt")


def _train_and_export(*arguments: Any, formats: Sequence[str] = ("torchscript", "onnx")) -> None:
    *overrides, run = arguments
    node = composed.composed("evaluation.episodes=200", "evaluation.in_a_row=2", *overrides)
    (run / ".hydra").mkdir()
    (run / ".hydra" / "config.yaml").write_text(OmegaConf.to_yaml(node))
    run_training(validate(TrainConfig, node), run)
    from physai.artifact import export as module  # it takes a second to import, which few tests need
    from physai.export import export

    config = load_config(run)
    with pytest.MonkeyPatch.context() as patch, open(run / "export.txt", "w") as said, redirect_stdout(said):
        patch.setattr(module, "TRANSFER_EPISODES", 10 if config.env.robot.floating else 100)  # legs are slow there
        export(run, "best", list(formats), config)


@pytest.fixture(scope="session")
def small_run(once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """A run as the command leaves it, and beside it what it printed, ``output.txt``; not to be written to."""
    return once("small_run", _run_command) / "run"


def _run_command(folder: Path) -> None:
    process = command("train", *SMALL, "hydra.run.dir=run", cwd=folder)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    (folder / "output.txt").write_text(output)
