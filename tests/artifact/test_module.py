"""The artifact's module: it scripts, shares nothing with training, and refuses what a robot cannot sense."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

from physai.artifact.module import DeployablePolicy, make_deployable, save, script
from physai.config import compose, validate
from physai.deploy.archive import content_sha256
from physai.envs.make import make
from physai.errors import UserError
from physai.training.agent import make_actor
from physai.training.config import TrainConfig
from tests.training.small import SMALL


def untrained(*overrides, num_envs=4):
    config = validate(TrainConfig, compose("train", [*SMALL, *overrides]))
    env = make(config.env.name, num_envs, overrides=["randomization=none"])
    env.normalization.update(torch.randn(100, env.observation_spec["observation"].shape[-1]) * 2 + 1)
    return make_actor(config, env), env


def sensed(rows, joints=2):
    return torch.randn(rows, joints), torch.randn(rows, joints), torch.randn(rows, 2)


@pytest.mark.parametrize("env", ["env=reacher", "env=kuka_reacher"])
@pytest.mark.parametrize("rows", [1, 5])
def test_scripted_and_eager_agree_to_the_last_bit(env, rows):
    actor, env = untrained(env)
    policy = make_deployable(actor, env)
    scripted = script(policy)
    for _ in range(20):
        inputs = sensed(rows)
        assert torch.equal(scripted(*inputs), policy(*inputs))
        assert torch.equal(scripted.distance(inputs[0], inputs[2]), policy.distance(inputs[0], inputs[2]))
    env.close()


@pytest.mark.parametrize(
    "in_keys",
    ["observation", "features", "normalized_observation", "features,observation", "observation,features"],
)
def test_a_policy_sees_its_in_keys_in_their_order(in_keys):
    actor, env = untrained(f"policy.actor.in_keys=[{in_keys}]")
    policy = make_deployable(actor, env)
    tensordict = env.reset()
    inputs = [tensordict[key] for key in ("joint_position", "joint_velocity", "goal")]
    action = actor(tensordict)["action"]
    torch.testing.assert_close(policy(*inputs), action * 2.0, rtol=0, atol=1e-6)
    assert torch.equal(script(policy)(*inputs), policy(*inputs))
    env.close()


def test_the_command_is_bounded_by_what_an_action_of_one_means():
    actor, env = untrained()
    with torch.no_grad():
        actor.network[-1].weight.mul_(1e4)
    command = make_deployable(actor, env)(*(1e6 * value for value in sensed(500)))
    assert command.abs().max() == 2.0
    env.close()


def test_it_is_frozen_and_goes_its_own_way():
    actor, env = untrained()
    policy = make_deployable(actor, env)
    inputs = sensed(3)
    before = policy(*inputs)
    with torch.no_grad():
        actor.network[0].weight.add_(1.0)
    env.normalization.update(torch.full((1000, 8), 100.0))
    assert torch.equal(policy(*inputs), before)
    assert not before.requires_grad
    assert not policy.training
    assert policy.in_keys == ["joint_position", "joint_velocity", "goal"]
    assert policy.out_keys == ["joint_velocity_command"]
    env.close()


def test_it_acts_on_a_tensordict_as_other_modules_do():
    actor, env = untrained()
    policy = make_deployable(actor, env)
    inputs = sensed(5)
    tensordict = TensorDict(dict(zip(policy.in_keys, inputs, strict=True)), [5])
    assert torch.equal(policy(tensordict)["joint_velocity_command"], policy(*inputs))
    again = TensorDictSequential(policy)(tensordict.select(*policy.in_keys))
    assert torch.equal(again["joint_velocity_command"], policy(*inputs))
    env.close()


def test_metadata_does_not_change_the_hash_of_code_and_weights():
    actor, env = untrained()
    scripted = script(make_deployable(actor, env))
    bare = content_sha256(save(scripted))
    assert content_sha256(save(scripted, '{"any": "thing"}')) == bare
    with torch.no_grad():
        next(scripted.network.parameters())[0, 0] += 1e-7
    assert content_sha256(save(scripted)) != bare
    env.close()


def test_a_policy_that_sees_the_physics_is_refused_by_name():
    actor, env = untrained()
    with pytest.raises(UserError, match=r"in_keys: a policy that sees 'physics_parameters' cannot be exported"):
        DeployablePolicy(
            env.simulation.observation,
            env.normalization.normalizer,
            actor.deterministic(),
            ["features", "physics_parameters"],
            torch.ones(2),
        )
    env.close()


class Unscriptable(torch.nn.Module):
    def forward(self, *anything):
        return anything[0]


def test_a_part_that_is_no_torchscript_is_refused_in_one_line():
    actor, env = untrained()
    actor.network[1] = Unscriptable()
    with pytest.raises(UserError, match="a part of it is no TorchScript") as refused:
        script(make_deployable(actor, env))
    assert "\n" not in str(refused.value)
    env.close()
