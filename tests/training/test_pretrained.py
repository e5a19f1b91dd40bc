"""A run begins with the best policy of another, and needs that one no more once it has begun."""

import json
import re
import shutil
from contextlib import closing

import pytest
import torch

from physai.errors import UserError
from physai.training import checkpoint
from physai.training.agent import Agent
from tests.training.small import SMALL, TINY, assert_same_run, forget_after, resume_here, run_here, small_config


def best_of(run):
    return checkpoint.load(run / "checkpoints" / "best.pt")


def assert_same(begun, trained):
    for part in ("actor", "normalization"):
        assert begun[part].keys() == trained[part].keys()
        assert all(torch.equal(value, trained[part][key]) for key, value in begun[part].items())


def test_it_begins_with_weights_and_statistics_and_with_a_critic_of_its_own(exported_run):
    critic = "policy.critic.in_keys=[normalized_observation,features,relative_parameters]"
    rotors = "physics=mujoco", "physics.motor=servo", "env.robot.armature=0.01"  # which the other run knows nothing of
    with closing(Agent.build(small_config(f"pretrained={exported_run}", critic, *rotors))) as agent:
        begun, trained = agent.policy_state(), best_of(exported_run)
        assert "relative_parameters" in agent.critic.in_keys
    assert_same(begun, trained)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [("algo=sac",), ("policy=gru",), ("policy=history", "algo=a2c")], ids=" ".join)
def test_policies_of_each_kind_go_on(kind, tmp_path):
    """Ten seconds each for networks of other shapes, and for what remembers."""
    run_here(tmp_path / "first", *TINY, *kind)
    run_here(tmp_path / "second", *TINY, *kind, f"pretrained={tmp_path / 'first'}", "total_frames=512")
    with closing(Agent.build(small_config(*kind, f"pretrained={tmp_path / 'first'}"))) as agent:
        begun, trained = agent.policy_state(), best_of(tmp_path / "first")
    assert_same(begun, trained)
    assert json.loads((tmp_path / "second" / "summary.json").read_text())["frames"] == 512


@pytest.mark.parametrize("collector", ["single", "async"])
def test_robots_act_by_it_from_the_first_frame_on_in_the_collectors_processes_too(exported_run, collector):
    config = small_config(f"pretrained={exported_run}", f"collector={collector}", "collector.num_envs=32")
    with closing(Agent.build(config)) as agent:
        batch = next(iter(agent.collector))
        assert torch.equal(agent.env.normalizer(batch["observation"]), batch["normalized_observation"])
        probability = agent.actor.get_dist(batch).log_prob(batch["latent_action"])
        torch.testing.assert_close(probability, batch["action_log_prob"])


@pytest.mark.slow
def test_what_it_began_with_stays_the_best_if_learning_only_harms_it(exported_run, tmp_path):
    run_here(tmp_path / "run", *TINY, f"pretrained={exported_run}", "algo.optimizer.lr=1.0", "env.task.max_steps=150")
    kept, trained = best_of(tmp_path / "run"), best_of(exported_run)
    assert all(torch.equal(value, trained["actor"][key]) for key, value in kept["actor"].items())
    assert kept["frames"] == json.loads((tmp_path / "run" / "summary.json").read_text())["best_frames"] == 0


@pytest.mark.slow
def test_a_run_that_was_killed_before_its_first_checkpoint_begins_with_it_again(exported_run, tmp_path):
    run_here(tmp_path / "run", *TINY, f"pretrained={exported_run}", "env.task.max_steps=150")
    whole = tmp_path / "whole"
    shutil.copytree(tmp_path / "run", whole)
    forget_after(tmp_path / "run", -1)
    (tmp_path / "run" / "metrics.csv").unlink()
    shutil.copy(whole / "checkpoints" / "best.pt", tmp_path / "run" / "checkpoints")  # which is written first
    resume_here(tmp_path / "run")
    assert_same_run(tmp_path / "run", whole)


@pytest.mark.slow
def test_it_goes_on_bit_for_bit_after_the_other_run_is_gone(exported_run, tmp_path):
    shutil.copytree(exported_run, tmp_path / "other")
    run_here(tmp_path / "whole", *SMALL, f"pretrained={tmp_path / 'other'}")
    shutil.rmtree(tmp_path / "other")
    shutil.copytree(tmp_path / "whole", tmp_path / "run")
    forget_after(tmp_path / "run", 6144)
    resume_here(tmp_path / "run")
    assert_same_run(tmp_path / "run", tmp_path / "whole")


def test_a_policy_that_does_not_fit_is_refused_in_one_line(exported_run, tmp_path):
    for given, line in (
        ((f"pretrained={tmp_path}",), f"pretrained: {tmp_path}: no run there (it has no .hydra/config.yaml)"),
        ((f"pretrained={exported_run}", "env=kuka_reacher"),
         f"pretrained: {exported_run} knows 'reacher', and 'kuka_reacher' has another env.robot"),
        ((f"pretrained={exported_run}", "env.robot.command_limit=1.5", "env.control_dt=0.01"),
         f"pretrained: {exported_run} knows 'reacher', and 'reacher' has another env.robot.command_limit and "
         "env.control_dt"),
        ((f"pretrained={exported_run}", "normalization.clip=5"),
         f"pretrained: the policy of {exported_run} has another normalization"),
        ((f"pretrained={exported_run}", "policy.actor.hidden_sizes=[32]"),
         f"pretrained: the policy of {exported_run} has policy.actor.hidden_sizes=[64, 64]"),
        ((f"pretrained={exported_run}", "policy=history"),
         f"pretrained: the policy of {exported_run} has policy.actor._target_=physai.policies.GaussianActor, "
         "no policy.actor.past_actions"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=f"^{re.escape(line)}$"):
            Agent.build(small_config(*given))
