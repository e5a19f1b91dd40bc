"""A policy that remembers, exported: its memory goes in and comes out, and the gate watches over both."""

import copy
import json

import numpy as np
import onnxruntime
import pytest
import torch

from physai.artifact import gate, onnx
from physai.artifact.module import make_deployable, save, script
from physai.artifact.states import States, extreme_states, roll_out
from physai.deploy import load_policy, read_metadata
from physai.deploy.policy import load_module
from physai.training.run import TrainedPolicy

COMMAND, SIZE = "joint_velocity_command", 40  # 32 of the unit, and four actions
KEYS = ["joint_position", "joint_velocity", "goal", "memory"]


@pytest.fixture(scope="module")
def trained(recurrent_run):
    actor, env = TrainedPolicy(recurrent_run, "best").deploy(64, seed=3)
    rollout = roll_out(actor, env)
    yield actor, env, rollout, States({key: rollout.get(key)[::20] for key in KEYS})
    env.close()


def test_over_a_thousand_steps_each_form_remembers_as_the_policy_does(trained, recurrent_run):
    actor, env, rollout, _ = trained
    work = States({key: rollout.get(key)[:1000] for key in KEYS})
    content = (recurrent_run / "policy.pt").read_bytes()
    policy = make_deployable(actor, env)
    expected = gate.unroll(gate.acting(actor, env), policy, work)
    assert {key: value.shape for key, value in expected.items()} == {COMMAND: (1000, 2), "new_memory": (1000, SIZE)}
    assert expected["new_memory"][-1].abs().max() > 0.1  # there is something to remember
    found = gate.unroll(load_module(content, KEYS, policy.measures), policy, work)
    assert all(torch.equal(found[key], expected[key]) for key in expected)
    runtime = onnx.Runtime((recurrent_run / "policy.onnx").read_bytes())
    found = gate.unroll(runtime, policy, work)
    assert all((found[key] - expected[key]).abs().max() < 1e-5 for key in expected)


def test_without_its_memory_it_would_act_otherwise(trained):
    actor, env, _, states = trained
    policy = make_deployable(actor, env)
    forgetful = policy(*(states | {"memory": torch.zeros(len(states), SIZE)}).values())[0]
    assert (policy(*states.values())[0] - forgetful).abs().max() > 0.05


def test_its_inputs_and_outputs_are_named_in_both_forms_and_in_the_metadata(recurrent_run):
    metadata = read_metadata(recurrent_run / "policy.pt")
    assert metadata.memory_size == SIZE
    assert metadata.inputs[-1].shape == metadata.outputs[-1].shape == (SIZE,)
    session = onnxruntime.InferenceSession(recurrent_run / "policy.onnx")
    assert [node.name for node in session.get_inputs()] == KEYS == [one.name for one in metadata.inputs]
    assert [node.name for node in session.get_outputs()] == [COMMAND, "new_memory"]
    assert [signal.name for signal in metadata.outputs] == [COMMAND, "new_memory"]
    assert json.loads(onnx.read_metadata((recurrent_run / "policy.onnx").read_bytes())) == metadata.raw


def test_golden_pairs_have_a_memory_before_and_after(recurrent_run):
    policy = load_policy(recurrent_run / "policy.pt")
    golden = policy.metadata.golden
    assert policy.golden_error == 0.0
    assert golden["memory"].shape == golden["new_memory"].shape == (32, SIZE)
    assert len(np.unique(golden["memory"], axis=0)) > 16
    for inputs, command, memory in zip(
        zip(*(golden[key] for key in KEYS), strict=True),
        golden["joint_velocity_command"],
        golden["new_memory"],
        strict=True,
    ):
        given, new_memory = policy(*inputs)
        assert np.array_equal(given, command)
        assert np.array_equal(new_memory, memory)


def forget(policy):
    policy.pipeline.network.forward = lambda seen, memory: type(policy.pipeline.network).forward(
        policy.pipeline.network, seen, memory * 0
    )


def keep_the_old_memory(policy):
    policy.pipeline.network.forward = lambda seen, memory: (
        type(policy.pipeline.network).forward(policy.pipeline.network, seen, memory)[0],
        memory,
    )


def tamper_with_the_cell(policy):
    with torch.no_grad():
        policy.pipeline.network.cell.weight_hh[3, 4] += 1e-3


@pytest.mark.parametrize(
    ("plant", "what"),
    [
        (forget, "joint_velocity_command differs by"),
        (keep_the_old_memory, "new_memory differs by"),
        (tamper_with_the_cell, "differs by"),
    ],
)
def test_what_is_planted_in_its_memory_is_found_and_named(trained, plant, what):
    actor, env, rollout, states = trained
    policy = make_deployable(actor, env)
    plant(policy)
    with pytest.raises(gate.GateError, match="the artifact is not the policy in its environment") as refused:
        gate.check_against_env(policy, actor, env, rollout, states)
    assert what in str(refused.value)
    assert "memory=[" in str(refused.value)
    with pytest.raises(gate.GateError, match="the artifact remembers otherwise: "):
        gate.check_recurrence({"the artifact": (policy, 0.0)}, gate.acting(actor, env), policy, states)


@pytest.mark.slow
def test_all_stages_of_the_gate_see_its_memory(trained):
    actor, env, rollout, states = trained
    policy = make_deployable(actor, env)
    extremes = extreme_states(policy, env)
    states = States({key: torch.cat([states[key], extremes[key]]) for key in KEYS})
    gate.check_against_env(policy, actor, env, rollout, states)
    expected, content = gate.answers(policy, policy, states), save(script(policy))
    assert list(expected) == [COMMAND, "new_memory", "error"]
    found = gate.ask_fresh_process(content, policy, states)
    assert all(torch.equal(found[key], expected[key]) for key in expected)
    wrong = expected | {"new_memory": expected["new_memory"].clone()}
    wrong["new_memory"][7, 5] += 1e-6
    with pytest.raises(gate.GateError, match=r"a stage: new_memory differs by .* memory=\["):
        gate.compare_answers("a stage", wrong, expected, states)
    other = copy.deepcopy(policy)
    tamper_with_the_cell(other)
    with pytest.raises(gate.GateError, match="ONNX Runtime disagrees"):
        gate.check_onnx(onnx.Runtime(onnx.convert(other, states)), policy, expected, states)
    assert gate.check_drive(content, policy, actor, env, 64, seed=5).success_rate > 0.9
