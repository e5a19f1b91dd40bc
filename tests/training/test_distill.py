"""A student is trained, resumed and exported as any policy is; its teacher comes from a run folder."""

import re
import shutil

import pytest
import torch

from physai.artifact import export
from physai.deploy import read_metadata
from physai.errors import UserError
from physai.training.agent import Agent
from physai.training.run import load_config
from tests.training.small import SMALL, assert_same_run, forget_after, resume_here, run_here, small_config, train_here

STUDENT = (*SMALL, "algo=distill", "randomization=strong", "collector.num_envs=64")


def of(teacher, *overrides):
    return (*STUDENT, f"algo.teacher={teacher}", *overrides)


@pytest.mark.slow
def test_the_teacher_sees_the_robots_parameters_and_says_what_it_would_do(teacher_run):
    agent = Agent.build(small_config(*of(teacher_run)))
    teacher = agent.algorithm.teacher
    batch = next(iter(agent.collector))
    assert teacher.normalizer is not agent.env.normalizer
    assert teacher.normalizer.loc.abs().max() > 0  # of its training
    labels = teacher(batch)
    others = teacher(batch.clone().set("relative_parameters", torch.zeros_like(batch["relative_parameters"])))
    assert labels.shape == batch["action"].shape == (64, 16, 2)
    assert (labels - others).abs().max() > 0.0
    losses = [agent.algorithm.update(batch)["loss_bc"] for _ in range(8)]
    agent.close()
    assert losses[-1] < losses[0]


@pytest.mark.slow
def test_one_seed_gives_one_run_whatever_the_process_did_before(teacher_run, tmp_path):
    hashes = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        torch.randn(5)
        config = small_config(*of(teacher_run, "total_frames=4096"))
        hashes.append(train_here(config, tmp_path / name).weights_sha256())
    assert hashes[0] == hashes[1]


@pytest.fixture(scope="module")
def finished(teacher_run, tmp_path_factory):
    run = tmp_path_factory.mktemp("distill") / "run"
    run_here(run, *of(teacher_run))
    return run


@pytest.mark.slow
def test_it_goes_on_from_a_checkpoint_bit_for_bit(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    forget_after(tmp_path / "run", 4096)
    resume_here(tmp_path / "run")
    assert_same_run(tmp_path / "run", finished)


@pytest.mark.slow
def test_a_student_passes_the_gate_with_its_memory_and_its_teacher_is_refused(
    finished, teacher_run, tmp_path, monkeypatch
):
    # five seconds: all stages of the gate, for what a student becomes on a robot
    monkeypatch.setattr(export, "TRANSFER_EPISODES", 8)
    shutil.copytree(finished, tmp_path / "run")
    stages = {}
    export.export_policy(tmp_path / "run", "best", ["torchscript"], stages.__setitem__, episodes=8)
    assert "over 1,024 steps: to the last bit" in stages["remembers as the policy does"]
    assert read_metadata(tmp_path / "run" / "policy.pt").memory_size == load_config(finished).memory_size == 32 + 4 * 2
    seen = r"a policy that sees 'relative_parameters' cannot be exported, for no robot can tell it"
    with pytest.raises(UserError, match=seen):
        export.export_policy(teacher_run, "best", ["torchscript"])


@pytest.mark.slow
def test_a_teacher_that_is_not_there_or_knows_another_robot_or_remembers_is_refused_in_one_line(
    teacher_run, finished, tmp_path
):
    for teacher, others, line in (
        (tmp_path, (), f"algo.teacher: {tmp_path}: no run there (it has no .hydra/config.yaml)"),
        (5, (), "algo.teacher: a run folder is needed, got 5"),
        (teacher_run, ("env=kuka_reacher",), f"algo.teacher: {teacher_run} knows 'reacher', and 'kuka_reacher' has "
         "another env.robot"),
        (teacher_run, ("env.control_dt=0.01",), f"algo.teacher: {teacher_run} knows 'reacher', and 'reacher' has "
         "another env.control_dt"),
        (finished, (), f"algo.teacher: the actor of {finished} must be a GaussianActor without memory, such "
         "as that of policy=privileged; it is a GRUActor"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=f"^{re.escape(line)}$"):
            Agent.build(small_config(*of(teacher, *others)))
    with pytest.raises(UserError, match=r"^algo\.teacher=\.\.\. is required$"):
        small_config("algo=distill")


def test_a_student_that_asks_for_what_the_env_does_not_give_is_refused(teacher_run):
    with pytest.raises(
        UserError, match=r"^policy\.actor\.in_keys: the env gives no 'featurs'; did you mean 'features'"
    ):
        Agent.build(small_config(*of(teacher_run, "policy.actor.in_keys=[featurs]")))
