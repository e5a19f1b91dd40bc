"""A run folder from elsewhere is data: whatever is in it, nothing of it is run."""

import importlib
import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from physai import artifact, cli, foreign, train
from physai.compose import conf_dir
from physai.config import validate
from physai.errors import UserError
from physai.plots.runs import plot_runs
from physai.training.config import TrainConfig
from physai.training.run import TrainedPolicy, load_config, run_training
from tests import malicious
from tests.composed import composed
from tests.training.small import SMALL, command

TINY = (*SMALL, "total_frames=2048", "checkpoint.every_frames=1024", "evaluation.goals=4", "evaluation.episodes=4")


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A run that is complete but for its summary, so that it can be resumed."""
    folder = tmp_path_factory.mktemp("foreign") / "run"
    node = composed(*TINY)
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "config.yaml").write_text(OmegaConf.to_yaml(node))
    (folder / ".hydra" / "overrides.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(list(TINY))))
    run_training(validate(TrainConfig, node), folder)
    (folder / "summary.json").unlink()
    return folder


@pytest.fixture
def run(finished, tmp_path, monkeypatch):
    """A copy of it, in a working directory with everything that a payload could use."""
    shutil.copytree(finished, tmp_path / "run")
    malicious.plant(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(sys.modules, "evil", None)
    monkeypatch.delitem(sys.modules, "evil")
    return Path("run")


def refused(capsys, function, *arguments) -> str:
    """Call it as a command does; return the line that it ends in."""
    before = set(sys.modules)
    with pytest.raises(SystemExit) as stop, cli.guard():
        function(*arguments)
    error = capsys.readouterr().err
    assert stop.value.code == 2, error
    assert len(error.splitlines()) == 1, error
    assert error.startswith("error: ")
    assert error.rstrip("\n").isprintable()
    assert len(error) < 500
    assert not Path("mark").exists()
    assert "evil" not in set(sys.modules) - before
    assert not Path("evaluation_").exists()
    return error


def evaluate(run):
    TrainedPolicy(run, "best", config=load_config(run)).evaluate(1)


def test_forty_ways_to_run_code_and_more():
    assert len(malicious.EVALUATE) + len(malicious.RESUME) + len(malicious.PLOT) >= 40


@pytest.mark.slow
def test_the_same_folder_without_a_payload_is_read_resumed_and_drawn(run):
    evaluate(run)
    plot_runs([run], run / "training.png")
    train._resume(run, ["allow=[mypackage]", "seed=0"])
    assert json.loads((run / "summary.json").read_text())["frames"] == 2048


@pytest.mark.slow
@pytest.mark.parametrize("case", malicious.EVALUATE)
def test_judging_a_run_from_elsewhere_executes_nothing(run, capsys, case):
    malicious.edit(run, malicious.EVALUATE[case])
    refused(capsys, evaluate, run)


@pytest.mark.slow
@pytest.mark.parametrize("case", malicious.RESUME)
def test_resuming_a_run_from_elsewhere_executes_nothing(run, capsys, case):
    malicious.edit(run, malicious.RESUME[case])
    refused(capsys, train._resume, run, ["seed=0"])


@pytest.mark.slow
@pytest.mark.parametrize("case", malicious.PLOT)
def test_drawing_a_run_from_elsewhere_executes_nothing(run, capsys, case):
    malicious.edit(run, malicious.PLOT[case])
    refused(capsys, plot_runs, [run], run / "training.png")


@pytest.mark.parametrize("module", ["evaluate", "export", "play"])
def test_the_other_commands_ask_before_anything_else(run, monkeypatch, capsys, module):
    malicious.edit(run, malicious.EVALUATE["a module beside the run"])
    monkeypatch.setattr(sys, "argv", [f"physai.{module}", "run=run", "allow=[mypackage]"])
    found = importlib.import_module(f"physai.{module}")
    job = getattr(found, f"_{module}")
    assert "may not name 'evil.Thing'" in refused(capsys, cli.main, module, job, found._check)


@pytest.mark.slow
def test_resume_refuses_a_module_of_the_working_directory(run):
    malicious.edit(run, malicious.EVALUATE["a module beside the run"])
    process = command("train", "resume=run", cwd=Path.cwd())
    output = process.communicate()[0]
    assert process.returncode == 2, output
    lines = [line for line in output.splitlines(keepends=True) if not line.startswith("pybullet build time")]
    assert "".join(lines) == (
        "error: run/.hydra/config.yaml: env.task._target_: a run folder may not name 'evil.Thing'; "
        "a package of your own you allow with allow=[<package>]\n"
    )
    assert not Path("mark").exists()


MINE = """
from physai.tasks import Reach
import os
from torch.nn import Linear
class Mine(Reach): pass
mine = Mine.__new__(Mine)
"""


@pytest.fixture
def own(run):
    """A run whose task is in a package of the user's."""
    Path("mypackage.py").write_text(MINE)
    malicious.edit(run, malicious.at("env.task._target_", "mypackage.Mine"))
    yield run
    sys.modules.pop("mypackage", None)


def test_a_package_of_ones_own_is_allowed_by_its_name(own):
    with pytest.raises(UserError, match=r"may not name 'mypackage.Mine'.*allow=\[<package>\]"):
        load_config(own)
    assert "mypackage" not in sys.modules
    assert load_config(own, ["mypackage"]).env.task["_target_"] == "mypackage.Mine"


@pytest.mark.parametrize("name", ["mypackage.os.system", "mypackage.mine", "mypackage.mine.check", "mypackage._Mine"])
def test_a_package_that_is_allowed_is_no_bridge_to_others(own, name):
    malicious.edit(own, malicious.at("env.task._target_", name))
    with pytest.raises(UserError, match=r"env\.task\._target_: "):
        load_config(own, ["mypackage"])


@pytest.mark.slow
def test_what_the_user_types_beside_resume_is_the_users_own(own):
    train._resume(own, ["env.task._target_=mypackage.Mine"])
    assert (own / "summary.json").is_file()


def test_what_the_user_types_must_be_what_the_run_folder_says(own, capsys):
    error = refused(capsys, train._resume, own, ["env.task._target_=mypackage.Other"])
    assert "may not name 'mypackage.Mine'" in error


@pytest.mark.slow
def test_a_run_of_ones_own_parts_is_judged_and_exported_where_it_was_trained(own, monkeypatch):
    exported = []

    def export(*_, config):
        exported.append(config)
        return SimpleNamespace(raw={"evaluation": {"transfer": None}})

    monkeypatch.setattr(artifact, "export_policy", export)
    malicious.edit(own, malicious.at("export.formats", ["torchscript", "onnx"]))
    train._resume(own, ["allow=[mypackage]"])
    assert (own / "summary.json").is_file()
    (config,) = exported
    assert config.env.task["_target_"] == "mypackage.Mine"


@pytest.mark.slow
@pytest.mark.parametrize(
    "choice",
    [f"{group}={path.stem}" for group in ("algo", "collector", "logger", "policy", "randomization")
     for path in sorted((conf_dir() / group).glob("*.yaml"))] + ["env=kuka_reacher"],
)  # fmt: skip
def test_whatever_conf_offers_passes(choice):
    node = composed(choice)
    plain = foreign.checked(OmegaConf.to_container(node), Path("config.yaml"), resume=True)
    assert plain == OmegaConf.to_container(node, resolve=True)


PARTS = [
    "physai.algorithms.proportional.ProportionalSampler",
    "physai.policies.GRUActor",
    "tensordict.nn.TensorDictModule",
    "torch.nn.GELU",
    "torch.optim.AdamW",
    "torch.optim.lr_scheduler.CosineAnnealingLR",
    "torchrl.data.LazyMemmapStorage",
    "torchrl.data.TensorDictPrioritizedReplayBuffer",
    "torchrl.data.replay_buffers.PrioritizedSampler",
    "torchrl.data.replay_buffers.writers.TensorDictRoundRobinWriter",
    "torchrl.modules.MLP",
    "torchrl.objectives.HardUpdate",
    "torchrl.objectives.KLPENPPOLoss",
    "torchrl.objectives.value.TDLambdaEstimator",
    "torchrl.record.loggers.CSVLogger",
]
NO_PARTS = [
    "builtins.eval",
    "physai.cli.main",
    "physai.physics.interface.os",
    "physai.policies.mlp",
    "physai.ros.RosPhysics",
    "physai.training.mlflow.os.system",
    "physai.training.run.run_training",
    "tensordict.TensorDict.load_memmap",
    "tensordict.nn.common.cloudpickle_loads",
    "torch.nn.Embedding.from_pretrained",
    "torch.nn.Module.load_state_dict",
    "torch.nn.functional.relu",
    "torch.nn.modules.__builtins__",
    "torch.optim.Adam.load_state_dict",
    "torch.package.PackageImporter",
    "torchrl.collectors.distributed.RayCollector",
    "torchrl.data.RayReplayBuffer",
    "torchrl.data.RemoteTensorDictReplayBuffer",
    "torchrl.data.ReplayBuffer.loads",
    "torchrl.data.StoreStorage",
    "torchrl.data.TensorStorage",
    "torchrl.data.datasets.D4RLExperienceReplay",
    "torchrl.envs.libs.gym.GymEnv",
    "torchrl.envs.transforms.R3MTransform",
    "torchrl.modules.LeRobotPolicyWrapper",
    "torchrl.modules.llm.TransformersWrapper",
    "torchrl.objectives.utils.importlib.import_module",
    "torchrl.record.loggers.RayLogger",
    "torchrl.record.loggers.get_logger",
]


def names(name):
    return {"part": {"_target_": name}}


@pytest.mark.parametrize("name", PARTS)
def test_parts_that_a_contributor_would_use_pass(name):
    assert foreign.checked(names(name), Path("config.yaml")) == names(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", NO_PARTS)
def test_what_loads_starts_or_fetches_does_not(name):
    with pytest.raises(UserError, match=r"^config\.yaml: part\._target_: "):
        foreign.checked(names(name), Path("config.yaml"))


def test_a_pickle_for_hydra_is_not_read(run, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["physai.train", "--experimental-rerun=evil.pkl"])
    assert "pickle" in refused(capsys, train.main)


def test_links_within_a_run_folder_stay(run):
    (run / "latest").symlink_to("checkpoints")
    assert load_config(run).seed == 0


@pytest.mark.parametrize("content", ["[]", "{}", "seven", '{"success_rate": []}', "[" * 100_000])
def test_a_damaged_summary_is_one_line(run, capsys, content):
    (run / "summary.json").write_text(content)
    assert "summary is damaged" in refused(capsys, train._resume, run, [])


def test_lists_of_lists_of_interpolations_are_refused_before_they_grow():
    node = {"first": ["x"] * 8} | {f"{n}": [f"${{{'first' if n == 0 else n - 1}}}"] * 8 for n in range(9)}
    with pytest.raises(UserError, match=r"the run's config is damaged \(more than 20,000 values\)"):
        foreign.checked(node, Path("config.yaml"))
