"""Every file in ``conf/`` composes into a valid config; walking the folders tests what is added."""

import os
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from torchrl.envs import TransformedEnv

import physai.compose
from physai.compose import compose, conf_dir
from physai.config import validate
from physai.errors import UserError
from physai.policies import GaussianActor
from physai.training.agent import Agent
from physai.training.config import TrainConfig
from tests.composed import composed

SMALL = ("collector=single", "collector.num_envs=4", "collector.frames_per_batch=64")


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (Path(conf_dir()) / group).glob("*.yaml"))


@cache
def chosen(group: str, choice: str) -> dict[str, str]:
    """What else is chosen with a choice, by group."""
    return dict(compose("train", [f"{group}={choice}"], hydra=True).hydra.runtime.choices)


@cache
def algorithm_of(policy: str) -> str:
    """The first algorithm that brings these networks along; PPO takes the others."""
    for name in choices("algo"):
        if chosen("algo", name)["policy"] == policy:
            return f"algo={name}"
    return "algo=ppo"


@cache
def env_with(group: str, choice: str) -> str:
    """The first environment that has this robot or task; the reacher's takes others."""
    for name in choices("env"):
        if chosen("env", name)[group] == choice:
            return f"env={name}"
    return "env=reacher"


BESIDE = {  # what a choice of these is made with
    "policy": algorithm_of,
    "robot@env.robot": partial(env_with, "robot@env.robot"),
    "task@env.task": partial(env_with, "task@env.task"),
}


def small(*overrides: str, teacher: Callable[[], Path] | None = None) -> TrainConfig:
    """A config of few robots and small batches, with a teacher where one is missing."""
    node = composed(*overrides, *SMALL)
    if "minibatch_size" in node.algo:
        node.algo.minibatch_size = 32
    if teacher is not None and OmegaConf.is_missing(node.algo, "teacher"):
        node.algo.teacher = str(teacher())
    return validate(TrainConfig, node)


@pytest.mark.slow
@pytest.mark.parametrize(
    "override",
    [
        f"{group}={name}"
        for group in (*BESIDE, "env", "algo", "randomization", "curriculum", "logger", "experiment")
        for name in choices(group.partition("@")[0])
    ],
)
def test_every_choice_builds_and_collects(override, request):
    group, name = override.split("=")
    beside = [BESIDE[group](name)] if group in BESIDE else []
    agent = Agent.build(small(*beside, override, teacher=partial(request.getfixturevalue, "teacher_run")))
    batch, zeros = next(iter(agent.collector)), TransformedEnv.fake_tensordict(agent.env)
    assert batch.shape == (4, 16)
    assert set(agent.env.fake_tensordict().keys(True, True)) == set(zeros.keys(True, True))  # for collecting processes
    agent.algorithm.update(batch)
    agent.close()


def without_servo(robot: str) -> bool:
    """Whether the joints of a robot are no springs, which take positions only."""
    return composed(f"robot@env.robot={robot}").env.robot.servo is None


@pytest.mark.slow
@pytest.mark.parametrize("robot", filter(without_servo, choices("robot")))
@pytest.mark.parametrize("command", ["joint_velocity", "joint_position"])
def test_every_robot_can_be_driven_by_velocities_and_by_positions(robot, command):
    agent = Agent.build(
        small(env_with("robot@env.robot", robot), f"robot@env.robot={robot}", f"env.robot.command={command}")
    )
    batch = next(iter(agent.collector))
    assert ("last_command" in batch.keys()) == (command == "joint_position")  # noqa: SIM118 (of a TensorDict)
    agent.algorithm.update(batch)
    agent.close()


def test_sb3_defaults_are_the_well_known_numbers():
    config = validate(TrainConfig, compose("train", ["experiment=sb3_defaults"]))
    algo = config.algo
    assert (algo["optimizer"]["lr"], algo["epochs"], algo["max_grad_norm"]) == (3e-4, 10, 0.5)
    assert (algo["advantage"]["gamma"], algo["advantage"]["lmbda"]) == (0.99, 0.95)
    assert (algo["loss"]["clip_epsilon"], algo["loss"]["entropy_coeff"], algo["loss"]["critic_coeff"]) == (
        0.2,
        0.005,
        0.5,
    )
    assert (config.collector.num_envs, config.collector.frames_per_batch) == (4, 4 * 2048)
    assert config.collector.in_process  # no batch is older than the policy
    assert algo["minibatch_size"] == 64
    assert algo["scheduler"] is None
    assert (config.total_frames, config.evaluation.every_frames, config.checkpoint.every_frames) == (
        500_000,
        10_000,
        50_000,
    )


def test_a_privileged_critic_sees_the_physics_that_the_actor_does_not():
    overrides = ["policy.critic.in_keys=[normalized_observation,features,physics_parameters]"]
    agent = Agent.build(small(*overrides))
    batch = next(iter(agent.collector))
    assert agent.critic.network[0].in_features == 8 + 12 + len(agent.env.simulation.layout.labels)
    agent.algorithm.update(batch)
    agent.close()


def test_the_package_carries_no_second_copy_of_the_configs():
    assert conf_dir() == Path(__file__).parent.parent / "conf"


def test_an_actor_that_remembers_more_than_its_config_says_is_refused():
    with pytest.raises(UserError, match=r"policy\.actor: how much an actor remembers is its argument memory_size"):
        Agent.build(small("policy.actor._target_=tests.test_config.Rememberer"))


class Rememberer(GaussianActor):
    """Its memory is nobody's business."""

    memory_size = 3


@pytest.mark.parametrize(("processes", "sync", "cores"), [(1, True, 1), (2, True, 2), (1, False, 2), (2, False, 3)])
def test_a_run_that_collects_while_it_learns_keeps_one_more_core_busy(processes, sync, cores):
    node = OmegaConf.create({"cores": f"${{cores_of_job:1,{processes},{sync}}}"})
    assert node.cores == cores


@pytest.mark.parametrize(
    ("limit", "cores"),
    [("150000 100000", 1), ("100 100000", 1), ("400000 100000", 4), ("2000000 100000", 8), ("max 100000", 8), ("", 8)],
)
def test_a_container_s_share_of_the_cores_is_all_that_there_is(monkeypatch, tmp_path, limit, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    (tmp_path / "cpu.max").write_text(limit)
    monkeypatch.setattr(physai.compose, "_CPU_MAX", tmp_path / "cpu.max")
    assert physai.compose.cores() == cores


def test_counts_may_be_written_as_people_write_them():
    config = validate(
        TrainConfig, compose("train", ["total_frames=1e6", "algo.epochs=1e1", "algo.minibatch_size=1_024"])
    )
    assert (config.total_frames, config.algo["epochs"], config.algo["minibatch_size"]) == (1_000_000, 10, 1024)
    assert isinstance(config.algo["epochs"], int)


@pytest.mark.parametrize("of", ["{}", "./{}", "/{}"])
def test_a_file_of_one_s_own_is_an_option_by_its_path(tmp_path, monkeypatch, of):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "found").mkdir()
    own = OmegaConf.merge(compose("train").randomization, {"name": "own"})
    OmegaConf.save(own, tmp_path / "found" / "own.yaml")
    path = of.format(f"{tmp_path}/found/own.yaml"[1:] if of.startswith("/") else "found/own.yaml")
    assert compose("train", [f"randomization={path}"]).randomization == own
    assert compose("evaluate", ["run=run", f"randomization={path}"]).randomization == own


def test_a_file_of_conf_comes_before_one_of_the_same_name_in_this_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    OmegaConf.save({"name": "own"}, tmp_path / "strong.yaml")
    assert compose("train", ["randomization=strong.yaml"]).randomization.name == "strong"


@pytest.mark.parametrize(
    ("text", "line"),
    [(None, "No such file"), ("a: [1,", "expected"), ("- 1", "it holds no keys"), ("\x00", "special characters")],
)
def test_a_file_that_is_no_config_is_refused_in_one_line(tmp_path, monkeypatch, text, line):
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / "own.yaml").write_text(text)
    with pytest.raises(UserError, match=line) as caught:
        compose("train", ["randomization=own.yaml"])
    assert str(caught.value).startswith("randomization=own.yaml: ")
    assert len(str(caught.value).splitlines()) == 1
