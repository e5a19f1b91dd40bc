"""Starting to train: heavy imports only where they are needed, and nothing is built twice."""

import multiprocessing
import subprocess
import sys

import pytest

from physai import train
from physai.cli import command as cli
from physai.collectors.single import RobotCollector
from physai.errors import UserError
from physai.training.agent import Agent
from tests.composed import composed
from tests.training.small import SMALL

AT_HELP = """
import sys
from physai import train
try:
    train.main()
finally:
    print(sorted({"torch", "torchrl", "pybullet", "scipy", "pandas", "matplotlib"} & set(sys.modules)))
"""

AT_THE_FIRST_FRAME = """
import os, sys
from physai import train
from physai.training import agent, trainer

built = []
build = agent.Agent.build
agent.Agent.build = lambda config: built.append(config) or build(config)

def first_frame(*_):
    print(sorted({"scipy.stats", "matplotlib", "onnx", "onnxruntime"} & set(sys.modules)), len(built))
    sys.stdout.flush()
    os._exit(0)

trainer.Trainer.fit = first_frame
train.main()
"""


def last_line(code, *arguments, cwd):
    done = subprocess.run([sys.executable, "-c", code, *arguments], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


@pytest.mark.slow
def test_help_imports_nothing_that_trains(tmp_path):
    assert last_line(AT_HELP, "--help", cwd=tmp_path) == "[]"


@pytest.mark.slow
def test_before_the_first_frame_nothing_is_built_twice_and_nothing_imported_that_draws_or_exports(tmp_path):
    assert last_line(AT_THE_FIRST_FRAME, *SMALL, "hydra.run.dir=run", cwd=tmp_path) == "[] 1"


@pytest.fixture
def training(monkeypatch):
    """The command, which notes what it would train instead of training it."""
    trained = []
    monkeypatch.setattr("physai.training.run.run_training", lambda config, run_dir, agent, watch: trained.append(agent))
    commands = []

    def make(keep):
        commands.append(train.Training(keep))
        return commands[-1], trained

    yield make
    for command in commands:
        command.close()
    for agent in trained:
        if agent is not None:
            agent.close()


@pytest.fixture
def built(monkeypatch):
    """What is built, in order."""
    built, build = [], Agent.build
    monkeypatch.setattr(Agent, "build", lambda config: built.append(build(config)) or built[-1])
    return built


def test_what_was_checked_is_what_a_run_trains(training, tmp_path):
    command, trained = training(keep=True)
    node = composed(*SMALL)
    command.check(node)
    command.train(node, tmp_path)
    command.train(node, tmp_path)
    assert trained[0] is not None
    assert trained[1] is None  # random numbers have been drawn since


@pytest.mark.slow
def test_the_jobs_of_a_sweep_build_their_own_and_its_check_keeps_no_robots(training, built, tmp_path):
    command, trained = training(keep=False)
    nodes = [composed(*SMALL, f"threads={threads}") for threads in (1, 2)]
    for node in nodes:
        command.check(node)
    assert [agent.env.simulation.physics._worlds for agent in built] == [[], []]
    assert not multiprocessing.active_children()
    for node in nodes:
        command.train(node, tmp_path)
    assert trained == [None, None]


@pytest.mark.slow
def test_a_sweep_s_check_builds_nothing_for_another_seed_and_starts_a_collector_once(training, built):
    command, _ = training(keep=False)
    for value in ("seed=0", "seed=1", "algo.optimizer.lr=1e-3", "policy=gru", "collector.processes=2"):
        command.check(composed(*SMALL, "collector=async", value))
    started = [not isinstance(agent.collector, RobotCollector) for agent in built]
    assert started == [True, False, True, True]
    with pytest.raises(UserError, match=r"seed"):
        command.check(composed(*SMALL, "collector=async", "seed=-1"))
    with pytest.raises(UserError, match=r"must be a multiple of collector\.processes \(3\)"):
        command.check(composed(*SMALL, "collector=async", "collector.processes=3"))


@pytest.mark.parametrize("error", [None, UserError("no such thing")])
def test_garbage_is_collected_again_after_the_check(error):
    import contextlib
    import gc

    with contextlib.suppress(UserError), cli._imports():
        assert not gc.isenabled()
        if error is not None:
            raise error
    assert gc.isenabled()
