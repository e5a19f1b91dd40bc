"""What is planted in an artifact, the gate finds: at which stage, at which input, how much."""

import copy
import json

import numpy as np
import pytest
import torch
from torch import nn

from physai.artifact import gate, onnx
from physai.artifact.module import make_deployable, save, script
from physai.artifact.states import ON_POLICY, States, extreme_states, roll_out
from physai.deploy import Metadata, read_metadata
from physai.deploy.metadata import metadata_sha256
from physai.training.run import TrainedPolicy

COMMAND = "joint_velocity_command"
KEYS = ("joint_position", "joint_velocity", "goal")


@pytest.fixture(scope="module")
def trained(exported_run):
    actor, env = TrainedPolicy(exported_run, "best").deploy(64, seed=3)
    rollout = roll_out(actor, env)
    yield actor, env, rollout, States({key: rollout.get(key)[::20] for key in KEYS})
    env.close()


@pytest.fixture
def check(trained):
    """Run the first stage on an artifact that something is planted in."""
    actor, env, rollout, states = trained
    policy = make_deployable(actor, env)

    def check(plant=lambda policy: None):
        plant(policy)
        gate.check_against_env(policy, actor, env, rollout, states)

    return check


def test_the_states_are_those_of_the_policy_at_work(trained):
    rollout = trained[2]
    assert len(rollout) == ON_POLICY >= 1000
    assert len(torch.unique(rollout["goal"], dim=0)) > 64  # episodes end and others begin
    assert rollout["joint_velocity"].abs().max() > 0.5
    assert (rollout["episode_length"] > 0).any()
    radius = rollout["goal"].norm(dim=-1)
    assert radius.min() >= 0.30 - 1e-6
    assert radius.max() <= 0.53 + 1e-6


def test_the_extremes_have_joint_limits_far_goals_and_huge_velocities(trained):
    states = extreme_states(make_deployable(*trained[:2]), trained[1])
    turns = 4 * torch.pi  # of a joint that turns without end
    for joint, ends in enumerate(torch.tensor([[-turns, turns], [-2.6, 2.6]])):
        for end in ends:
            assert (states["joint_position"][:, joint] == end).any()
    assert states["goal"].norm(dim=1).max() > 5.0
    assert states["joint_velocity"].abs().max() == 250.0
    assert torch.isfinite(torch.cat(list(states.values()), dim=1)).all()


def test_an_artifact_is_equal_to_its_policy(check):
    check()


def tamper_with_a_weight(policy):
    with torch.no_grad():
        policy.pipeline.network[2].weight[5, 7] += 1e-3


def forget_the_normalizer(policy):
    policy.pipeline.normalizer.loc.zero_()
    policy.pipeline.normalizer.scale.fill_(1.0)


def forget_the_scale(policy):
    policy.pipeline.command.scale.fill_(1.0)


def swap_the_joints(policy):
    with torch.no_grad():
        last = policy.pipeline.network[-2]
        last.weight.copy_(last.weight.flip(0))
        last.bias.copy_(last.bias.flip(0))


def swap_the_inputs(policy):
    policy.pipeline.seen = policy.pipeline.seen[::-1]


class OtherLayout(nn.Module):
    """Velocities before positions."""

    def __init__(self, inner):
        super().__init__()
        self.inner = inner

    def forward(self, q, qd, goal):
        observation, features = self.inner(q, qd, goal)
        return torch.cat([observation[:, 2:4], observation[:, :2], observation[:, 4:]], dim=1), features

    def error(self, q, goal):
        return self.inner.error(q, goal)


def change_the_layout(policy):
    policy.pipeline.observation = OtherLayout(policy.pipeline.observation)


def lengthen_a_link(policy):
    policy.pipeline.observation.kinematics.constant[1, 0, 3] += 0.001


def break_the_error(policy):
    policy.pipeline.observation.error = lambda q, goal: torch.zeros(len(q), 1)


@pytest.mark.parametrize(
    ("plant", "what"),
    [
        (tamper_with_a_weight, "joint_velocity_command differs by"),
        (forget_the_normalizer, "normalized_observation differs by"),
        (forget_the_scale, "joint_velocity_command differs by"),
        (swap_the_joints, "joint_velocity_command differs by"),
        (swap_the_inputs, "joint_velocity_command differs by"),
        (change_the_layout, ": observation differs by"),
        (lengthen_a_link, ": observation differs by"),
        (break_the_error, "error differs by"),
    ],
)
def test_what_is_planted_is_found_and_named(check, plant, what):
    with pytest.raises(gate.GateError) as refused:
        check(plant)
    message = str(refused.value)
    assert message.startswith("the artifact is not the policy in its environment")
    assert what in message
    assert "joint_position=[" in message
    assert "goal=[" in message
    assert "\n" not in message


def test_what_is_planted_in_the_scripted_form_alone_is_found(trained):
    actor, env, _, states = trained
    policy = make_deployable(actor, env)
    expected = gate.answers(policy, policy, states)
    policy.pipeline.observation.kinematics.constant.mul_(0.999)
    scripted = script(policy)
    commands = gate.answers(scripted, policy, states)
    with pytest.raises(gate.GateError, match="a stage: joint_velocity_command differs by"):
        gate.compare_answers("a stage", commands, expected, states)
    commands["joint_velocity_command"] = expected["joint_velocity_command"]
    with pytest.raises(gate.GateError, match="a stage: error differs by"):
        gate.compare_answers("a stage", commands, expected, states)


def swap_limits(raw):
    raw["limits"]["position"].reverse()


def forget_limits(raw):
    raw["limits"]["position"] = [[None, None]] * 2


def raise_the_velocity(raw):
    raw["limits"]["velocity"] = [100.0, 100.0]


def lower_the_command(raw):
    raw["limits"]["command"] = [0.001, 0.001]


def other_rate(raw):
    raw["control_rate"] = 500.0


def other_frame(raw):
    raw["inputs"][2]["frame"] = "world"


def other_ring(raw):
    raw["goal"]["region"] |= {"inner": 0.0, "outer": 50.0}


def other_tolerance(raw):
    raw["goal"]["tolerances"][0]["value"] = 0.5


def other_bounds(raw):
    raw["outputs"][0]["high"] = [9.0, 9.0]


def other_home(raw):
    raw["robot"]["home"] = [0.0, 1.0]


def other_joints(raw):
    for labels in (raw["robot"]["joints"], *(one["labels"] for one in raw["inputs"] + raw["outputs"])):
        if "joint1" in labels:
            labels.reverse()


def other_urdf(raw):
    raw["robot"]["urdf_sha256"] = "0" * 64


@pytest.mark.parametrize(
    ("plant", "what"),
    [
        (other_joints, "joints is"),
        (other_home, "home is"),
        (other_bounds, "outputs is"),
        (swap_limits, "position_limit is"),
        (forget_limits, "position_limit is"),
        (raise_the_velocity, "velocity_limit is"),
        (lower_the_command, "command_limit is"),
        (other_rate, "control_rate is 500.0, not 50.0"),
        (other_frame, "inputs is"),
        (other_ring, "region is"),
        (other_tolerance, "tolerances is"),
        (other_urdf, "urdf_sha256"),
    ],
)
def test_what_is_planted_in_the_metadata_is_found_and_named(trained, exported_run, plant, what):
    raw = copy.deepcopy(read_metadata(exported_run / "policy.pt").raw)
    plant(raw)
    metadata = Metadata.parse(json.dumps(raw | {"metadata_sha256": metadata_sha256(raw)}))
    with pytest.raises(gate.GateError, match="the metadata is wrong") as refused:
        gate.check_metadata(
            metadata, trained[1].simulation, make_deployable(*trained[:2]), {COMMAND: torch.zeros(1, 2)}
        )
    assert what in str(refused.value)


def test_a_policy_that_commands_more_than_its_file_says_is_found(trained, exported_run):
    metadata = read_metadata(exported_run / "policy.pt")
    too_much = {COMMAND: torch.tensor([[0.0, -2.01]])}
    with pytest.raises(gate.GateError, match=r"commands \[0.0, -2.0.*\] rad/s, beyond its limits"):
        gate.check_metadata(metadata, trained[1].simulation, make_deployable(*trained[:2]), too_much)


def test_one_ulp_in_one_weight_is_found_at_batch_one(trained):
    actor, env, rollout, states = trained
    policy = make_deployable(actor, env)
    before = gate.answers(policy, policy, states)
    weight = policy.pipeline.network[-2].weight.detach().view(-1)
    for index in weight.abs().argsort(descending=True):
        was = weight[index].clone()
        weight[index] = torch.nextafter(was, torch.tensor(torch.inf))
        now = gate.answers(policy, policy, states)
        if not torch.equal(now[COMMAND], before[COMMAND]):
            break
        weight[index] = was  # its last bit is lost in the sum with all the others
    with pytest.raises(gate.GateError, match="joint_velocity_command differs by"):
        gate.check_against_env(policy, actor, env, rollout, states)


def test_a_number_that_is_not_finite_is_a_difference(trained):
    states = trained[3]
    expected = torch.zeros(len(states), 2)
    found = expected.clone()
    found[4, 1] = torch.nan
    with pytest.raises(gate.GateError, match="stage: command differs by inf") as refused:
        gate.compare_answers("stage", {"command": found}, {"command": expected}, states, tolerance=1.0)
    assert states.describe(4) in str(refused.value)
    with pytest.raises(gate.GateError, match=r"shape \[3, 2\]"):
        gate.compare_answers("stage", {"command": expected[:3]}, {"command": expected}, states)


@pytest.mark.slow
def test_a_fresh_process_without_physai_gives_the_same_bits(trained):
    actor, env, _, states = trained
    policy = make_deployable(actor, env)
    found = gate.ask_fresh_process(save(script(policy)), policy, states)
    expected = gate.answers(policy, policy, states)
    assert list(found) == list(expected)
    assert all(torch.equal(found[key], expected[key]) for key in expected)


@pytest.mark.slow
def test_a_file_that_a_fresh_process_cannot_run_is_refused(trained):
    with pytest.raises(gate.GateError, match="a fresh process without physai cannot run the file"):
        gate.ask_fresh_process(b"not a file of torch", make_deployable(*trained[:2]), trained[3])


@pytest.mark.slow
def test_onnx_agrees_and_what_is_planted_in_it_is_found(trained):
    actor, env, _, states = trained
    policy = make_deployable(actor, env)
    expected = gate.answers(policy, policy, states)
    content = onnx.convert(policy, states)
    assert gate.check_onnx(onnx.Runtime(content), policy, expected, states) <= 1e-5
    wrong = copy.deepcopy(policy)
    tamper_with_a_weight(wrong)
    with pytest.raises(gate.GateError, match=r"ONNX Runtime disagrees \(one by one\): joint_velocity_command differs"):
        gate.check_onnx(onnx.Runtime(onnx.convert(wrong, states)), policy, expected, states)


@pytest.mark.slow
def test_an_artifact_that_drives_worse_is_refused(trained):
    actor, env, _, _ = trained
    policy = make_deployable(actor, env)
    driven = gate.check_drive(save(script(policy)), policy, actor, env, 64, seed=5)
    assert driven.success_rate > 0.9
    policy.pipeline.command.scale.mul_(-1)
    with pytest.raises(gate.GateError, match="does not drive as the policy does: of 64 episodes"):
        gate.check_drive(save(script(policy)), policy, actor, env, 64, seed=5)


@pytest.mark.slow
def test_in_closed_loop_the_artifact_succeeds_as_the_policy_does_on_four_hundred_goals(exported_run):
    trained = TrainedPolicy(exported_run, "best")
    actor, env = trained.deploy(400, seed=11)
    content = (exported_run / "policy.pt").read_bytes()
    driven = gate.check_drive(content, make_deployable(actor, env), actor, env, 400, seed=11)
    judged = trained.evaluate(400, seed=11)
    print(f"artifact {driven.success_rate:.1%}, policy {judged.success_rate:.1%}")
    assert abs(driven.success_rate - judged.success_rate) <= 0.01
    assert driven.success_rate > 0.9
    np.testing.assert_allclose(driven.summary()["return"], judged.summary()["return"], rtol=0.01)
    env.close()
