"""The gate asks a second engine."""

import json
import shutil

import pytest
import torch

from physai.artifact import export as module
from physai.artifact import export_policy, gate, transfer
from physai.deploy import read_metadata
from physai.errors import UserError
from physai.training.evaluation import Evaluation
from physai.training.run import load_config

ENVS = {
    "planar arm": ("reacher",),
    "planar arm by positions": ("reacher", "env.robot.command=joint_position"),
    "KUKA": ("kuka_reacher",),
    "Panda": ("panda_reach",),
    "KUKA with seven joints": ("kuka7_reach",),
    "xArm": ("xarm_reach",),
}


def planted(name):
    physics = transfer.other_engine({"_target_": "physai.physics.pybullet.PyBulletPhysics"})
    return physics | {"_target_": f"tests.artifact.planted.{name}"}


@pytest.mark.slow
@pytest.mark.parametrize("env", ENVS)
@pytest.mark.parametrize("engine", ["PyBullet", "MuJoCo"])
def test_the_engines_move_each_joint_alike(env_config, env, engine):
    physics = ["physics=mujoco", "physics.motor=impulse"] if engine == "MuJoCo" else []
    config = env_config(*ENVS[env], *physics)
    other = transfer.other_engine(config.physics)
    assert other["_target_"] != config.physics["_target_"]
    assert transfer.differences(config, other) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Flipped", "{last} turns the other way"),
        ("Swapped", "a command for {first} moves {second}"),
        ("Late", "commands arrive 3 control steps later"),
        ("Weak", "the motor of {last} has less effort: with the same limit it gets 0."),
    ],
)
@pytest.mark.parametrize("env", ["planar arm", "KUKA", "Panda"])
def test_what_is_planted_in_the_other_engine_is_named(env_config, env, name, said):
    config = env_config(*ENVS[env])
    first, second, *_ = config.robot.joints
    found = transfer.differences(config, planted(name))
    wanted = said.format(first=first, second=second, last=config.robot.joints[-1])
    assert any(line.startswith(wanted) for line in found), found


@pytest.fixture
def required(exported_run, tmp_path):
    """A copy of a run without its policy files, and its config, which requires that the other engine agrees."""
    run = tmp_path / "run"
    shutil.copytree(exported_run, run, ignore=shutil.ignore_patterns("policy.*"))
    config = load_config(run)
    return run, config.model_copy(update={"export": config.export.model_copy(update={"transfer": "require"})})


@pytest.mark.slow
def test_a_run_that_requires_transfer_gets_no_file_where_arms_differ(required, monkeypatch):
    run, config = required
    physics = planted("Weak")  # which this policy does not even notice
    monkeypatch.setattr(transfer, "other_engine", lambda _: physics)
    monkeypatch.setattr(module, "TRANSFER_EPISODES", 50)
    with pytest.raises(gate.GateError, match="the motor of joint1 has less effort"):
        export_policy(run, "best", ["torchscript"], episodes=8, config=config)
    assert not list(run.glob("policy.*"))


def evaluation(rate, episodes=1000):
    success, zeros = torch.arange(episodes) < rate * episodes, torch.zeros(episodes)
    return Evaluation(success, success, ~success, zeros, zeros, zeros, zeros, zeros, "m")


@pytest.mark.parametrize(
    ("own", "other", "said"),
    [
        (0.99, 0.985, None),
        (0.96, 0.96, "reaches 96.0% of 1,000 goals in the other engine, for certain 94.6%; 97% are required"),
        (1.0, 0.985, "reaches 98.5% of 1,000 goals in the other engine, and 100.0% in its own; at most 1% may be lost"),
    ],
)
def test_a_low_rate_or_a_drop_is_refused(own, other, said):
    opinion = transfer.Opinion({"_target_": "x.Physics"}, 0.0, evaluation(other), [], 1000, "default")
    if said is None:
        opinion.require(evaluation(own))
    else:
        with pytest.raises(gate.GateError, match=said):
            opinion.require(evaluation(own))


def test_files_and_summary_say_how_the_policy_drives_in_the_other_engine(exported_run):
    assert "drives in MuJoCo" in (exported_run / "export.txt").read_text()
    said = read_metadata(exported_run / "policy.pt").raw["evaluation"]["transfer"]
    assert said["physics"]["_target_"] == "physai.physics.mujoco.MuJoCoPhysics"
    assert said["physics"]["motor"] == "servo"
    assert said["armature"] == 0.01
    assert said["episodes"] == 100
    assert said["differences"] == []
    for name in ("success", "settled"):
        low, high = said[f"{name}_ci"]
        assert low <= said[f"{name}_rate"] <= high
    summary = json.loads((exported_run / "summary.json").read_text())
    assert summary["transfer"] == said
    assert summary["frames"] > 80_000


@pytest.mark.slow
def test_without_the_other_engine_a_run_that_requires_it_stops_and_others_are_told(required, monkeypatch):
    run, config = required
    monkeypatch.setattr(transfer.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"the other engine needs 'mujoco', .*: pip install 'physai\[mujoco\]'"):
        transfer.other_engine(config.env.physics)
    with pytest.raises(gate.GateError, match=r"export\.transfer=require: the other engine needs 'mujoco'"):
        export_policy(run, "best", ["torchscript"], episodes=8, config=config)
    assert not list(run.glob("policy.*"))
    told = {}
    export_policy(run, "last", ["torchscript"], told.__setitem__, episodes=8, config=load_config(run))
    assert told["drives in the other engine"].startswith("not asked: the other engine needs 'mujoco'")
    assert read_metadata(run / "policy.pt").raw["checkpoint"]["which"] == "last"
