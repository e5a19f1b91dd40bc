"""Exporting a run: what lies in its folder afterwards, and what does not when something disagrees."""

import hashlib
import json
import shutil
from contextlib import closing
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

import physai
from physai.artifact import export as module
from physai.artifact import export_policy, gate
from physai.artifact.inspect import show
from physai.artifact.onnx import describe
from physai.deploy import load_policy, read_metadata
from physai.deploy.metadata import metadata_sha256
from physai.errors import UserError
from physai.training.run import TrainedPolicy
from tests.training.small import EXPORTED, TINY, command


@pytest.fixture(autouse=True)
def _few_goals_in_the_other_engine(monkeypatch):
    """tests/artifact/test_transfer.py asks it."""
    monkeypatch.setattr(module, "TRANSFER_EPISODES", 8)


@pytest.fixture
def copied(exported_run, tmp_path):
    shutil.copytree(exported_run, tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture(scope="module")
def agreed(exported_run):
    """The forms of its best policy, and its simulation: what is written may be checked without making them anew."""
    trained = TrainedPolicy(exported_run, "best")
    actor, env = trained.deploy(64, seed=0)
    with closing(env):
        yield module.agreeing_forms(actor, env, ["torchscript", "onnx"], lambda *_: None), env.simulation


def metadata_of(run):
    files = {"metadata.json": ""}
    torch.jit.load(run / "policy.pt", _extra_files=files)
    return json.loads(files["metadata.json"])


def test_the_hash_beside_the_policy_is_its_own(exported_run):
    digest, name = (exported_run / "policy.pt.sha256").read_text().split()
    assert name == "policy.pt"
    assert digest == hashlib.sha256((exported_run / "policy.pt").read_bytes()).hexdigest()
    assert load_policy(exported_run / "policy.pt", sha256=digest).sha256 == digest


def test_the_metadata_says_everything_a_robot_must_know(exported_run):
    raw = metadata_of(exported_run)
    assert (raw["format"], raw["format_version"]) == ("physai.policy", 4)
    assert raw["robot"]["name"] == "planar_arm"
    assert raw["robot"]["joints"] == ["joint1", "joint2"]
    assert raw["limits"] == {
        "position": [[None, None], [-2.6, 2.6]],
        "velocity": [2.5, 2.5],
        "effort": [5.0, 3.0],
        "command": [2.0, 2.0],
    }
    assert raw["control_rate"] == 50.0
    assert [(one["name"], one["shape"], one["unit"]) for one in raw["inputs"] + raw["outputs"]] == [
        ("joint_position", [2], "rad"),
        ("joint_velocity", [2], "rad/s"),
        ("goal", [2], "m"),
        ("joint_velocity_command", [2], "rad/s"),
    ]
    assert raw["inputs"][0]["low"] == [None, -2.6]
    assert raw["inputs"][2]["frame"] == "base"
    assert raw["goal"] == {
        "region": {"kind": "ring", "inner": 0.30, "outer": 0.53},
        "tolerances": [{"name": "distance", "unit": "m", "value": 0.05}],
    }
    urdf = Path(physai.__path__[0]) / "robots" / "assets" / "planar_arm.urdf"
    assert raw["robot"]["urdf_sha256"] == hashlib.sha256(urdf.read_bytes()).hexdigest()
    assert raw["config"]["total_frames"] == 80_000
    low, high = raw["evaluation"]["success_ci"]
    assert low <= raw["evaluation"]["success_rate"] <= high
    assert raw["evaluation"]["episodes"] == 200
    assert raw["versions"]["torch"] == torch.__version__
    assert {"physai", "torchrl"} <= set(raw["versions"])
    assert raw["created"].endswith("+00:00")
    assert "git_commit" in raw


def test_torchscript_and_onnx_carry_the_same_metadata(exported_run):
    files = {"metadata.json": ""}
    torch.jit.load(exported_run / "policy.pt", _extra_files=files)
    properties = onnx.load(exported_run / "policy.onnx").metadata_props
    assert {entry.key: entry.value for entry in properties}["metadata.json"].encode() == files["metadata.json"]


def test_golden_pairs_are_full_precision_and_hold_in_both_forms(exported_run):
    policy = load_policy(exported_run / "policy.pt")
    golden = policy.metadata.golden
    session = onnxruntime.InferenceSession(exported_run / "policy.onnx")
    assert len(golden["goal"]) == 32
    assert policy.golden_error == 0.0
    for row in range(32):
        inputs = {key: golden[key][row] for key in ("joint_position", "joint_velocity", "goal")}
        assert np.array_equal(policy(*inputs.values()), golden["joint_velocity_command"][row])
        (command,) = session.run(None, {key: value[None] for key, value in inputs.items()})
        np.testing.assert_allclose(command[0], golden["joint_velocity_command"][row], rtol=0, atol=1e-5)


@pytest.mark.slow
def test_an_ideal_arm_reaches_twenty_goals_in_a_row_without_going_home(exported_run):
    arms, metadata = 64, read_metadata(exported_run / "policy.pt")
    lower, upper = torch.from_numpy(metadata.position_limit).float().T
    policy, draw = torch.jit.load(exported_run / "policy.pt"), torch.Generator().manual_seed(0)
    q = v = farthest = torch.zeros(arms, 2)
    for _ in range(20):
        radius, angle = torch.rand(2, arms, 1, generator=draw)
        ring = metadata.region
        radius = ring.inner + (ring.outer - ring.inner) * radius
        goal = radius * torch.cat([torch.cos(6.2832 * angle), torch.sin(6.2832 * angle)], 1)
        for _ in range(200):
            away = policy.error(q, goal) >= metadata.tolerances[0].value
            v = policy(q, v, goal) * away
            q = torch.clamp(q + v / metadata.control_rate, lower, upper)
            farthest = torch.maximum(farthest, q.abs())
        assert not away.any()
    assert farthest[:, 0].max() > 4 * torch.pi  # some have turned around more than twice


def plant(monkeypatch, defect):
    def make(actor, env):
        policy = make_deployable(actor, env)
        defect(policy)
        return policy

    make_deployable = module.make_deployable
    monkeypatch.setattr(module, "make_deployable", make)


def test_what_does_not_pass_the_gate_leaves_the_old_files_as_they_were(copied, monkeypatch):
    before = {path: path.read_bytes() for path in copied.glob("policy.*")}
    assert len(before) == 3
    plant(monkeypatch, lambda policy: policy.pipeline.normalizer.loc.zero_())
    with pytest.raises(gate.GateError, match="normalized_observation differs by"):
        export_policy(copied, "best", ["torchscript", "onnx"])
    assert {path: path.read_bytes() for path in copied.glob("policy.*")} == before


def test_a_policy_whose_hash_could_not_be_written_lies_beside_none_and_not_beside_the_old_one(tmp_path):
    path = tmp_path / "policy.pt"
    module._publish(path, b"old")
    (tmp_path / ".policy.pt.sha256.tmp").mkdir()  # which the hash would be written to
    with pytest.raises(OSError, match="sha256"):
        module._publish(path, b"new")
    assert path.read_bytes() == b"new"
    assert not path.with_name("policy.pt.sha256").exists()


def written(run, agreed, exported_run, formats):
    forms, simulation = agreed
    module.write(run, formats, forms, simulation, metadata_of(exported_run))


@pytest.mark.slow
def test_a_file_for_joints_in_another_order_is_refused_before_it_is_written(
    agreed, exported_run, tmp_path, monkeypatch
):
    described = module.describe.describe_robot

    def swapped(*parts):
        content = described(*parts)
        for labels in (content["robot"]["joints"], *(one["labels"] for one in content["inputs"] + content["outputs"])):
            if "joint1" in labels:
                labels.reverse()
        return content

    monkeypatch.setattr(module.describe, "describe_robot", swapped)
    with pytest.raises(UserError, match=r"the metadata is wrong: joints is \('joint2', 'joint1'\)"):
        written(tmp_path, agreed, exported_run, ["torchscript", "onnx"])
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_onnx_metadata_that_are_not_those_of_the_policy_are_refused(agreed, exported_run, tmp_path, monkeypatch):
    described = module.onnx.describe
    monkeypatch.setattr(module.onnx, "describe", lambda content, text: described(content, text.replace("joint1", "x")))
    with pytest.raises(gate.GateError, match="the metadata of the ONNX file is not that of the policy"):
        written(tmp_path, agreed, exported_run, ["onnx"])
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_only_the_asked_form_is_written(agreed, exported_run, tmp_path):
    written(tmp_path, agreed, exported_run, ["torchscript"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy.pt", "policy.pt.sha256"]


def test_each_stage_is_reported(exported_run):
    text = (exported_run / "export.txt").read_text()
    for part in ("1,024 states", "extremes", "to the last bit", "fresh process", "ONNX in ONNX", "drives 200 episodes"):
        assert part in text


@pytest.mark.parametrize("name", ["policy.pt", "policy.onnx"])
def test_inspect_shows_it_to_people(exported_run, capsys, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "200")
    show(exported_run / name)
    shown = capsys.readouterr().out
    for part in (
        "planar_arm",
        "joint2",
        "-2.6 to 2.6",
        "50 Hz",
        "inner 0.3, outer 0.53",
        "success",
        "torchrl",
        "clip: 10.0",
    ):
        assert part in shown


def test_inspect_names_what_people_are_not_told(exported_run, tmp_path):
    raw = metadata_of(exported_run)
    del raw["evaluation"]["success_ci"]
    raw["metadata_sha256"] = metadata_sha256(raw)
    path = tmp_path / "policy.onnx"
    path.write_bytes(describe((exported_run / "policy.onnx").read_bytes(), json.dumps(raw)))
    with pytest.raises(UserError, match=r"policy\.onnx: the metadata lacks 'success_ci'"):
        show(path)


@pytest.mark.slow
def test_training_the_kuka_leaves_a_policy_and_its_hash(tmp_path):
    process = command("train", *TINY, EXPORTED, "env=kuka_reacher", "hydra.run.dir=run", cwd=tmp_path)
    output = process.communicate()[0]
    assert process.returncode == 0, output
    names = {"policy.pt", "policy.pt.sha256", "policy.onnx"}
    assert names <= {path.name for path in (tmp_path / "run").iterdir()}
    assert "Written to run: policy.pt, policy.onnx, policy.pt.sha256" in output
    policy = load_policy(tmp_path / "run" / "policy.pt", expect_joints=["lbr_iiwa_joint_1", "lbr_iiwa_joint_2"])
    assert policy.metadata.command_limit.tolist() == [0.5, 0.5]
    assert policy.metadata.goal.frame == "lbr_iiwa_link_0"
