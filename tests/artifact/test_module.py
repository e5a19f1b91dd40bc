"""The artifact's module: it scripts, shares nothing with training, and refuses what a robot cannot sense."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

from physai.artifact.module import make_deployable, save, script
from physai.config import validate
from physai.deploy.archive import content_sha256
from physai.envs.make import make
from physai.errors import UserError
from physai.training.agent import make_actor
from physai.training.config import TrainConfig
from physai.transforms import RunningStatistics
from tests.composed import composed
from tests.training.small import SMALL


def untrained(*overrides, num_envs=4):
    config = validate(TrainConfig, composed(*SMALL, *overrides))
    given = [one for one in overrides if one.startswith("env.")]
    env = make(config.env.name, num_envs, overrides=["randomization=none", *given])
    RunningStatistics(env.normalizer, 0.01).update(
        torch.randn(100, env.observation_spec["observation"].shape[-1]) * 2 + 1
    )
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
        assert torch.equal(scripted.error(inputs[0], inputs[2]), policy.error(inputs[0], inputs[2]))
    env.close()


@pytest.mark.slow
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
    RunningStatistics(env.normalizer, 0.01).update(torch.full((1000, 8), 100.0))
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
    actor.in_keys = ["features", "physics_parameters"]
    with pytest.raises(UserError, match=r"in_keys: a policy that sees 'physics_parameters' cannot be exported"):
        make_deployable(actor, env)
    env.close()


def test_a_policy_that_commands_positions_moves_the_last_command_on():
    actor, env = untrained("env.robot.command=joint_position")
    policy = make_deployable(actor, env)
    assert policy.in_keys == ["joint_position", "joint_velocity", "goal", "last_command"]
    assert policy.out_keys == ["joint_position_command"]
    tensordict = env.reset()
    inputs = [tensordict[key] for key in policy.in_keys]
    moved = policy(*inputs) - tensordict["last_command"]
    torch.testing.assert_close(moved, actor(tensordict)["action"] * 2.0 * 0.02, rtol=0, atol=1e-6)
    env.close()


@pytest.mark.slow
def test_policies_of_both_kinds_script_in_one_process_each_with_its_own_inputs():
    schemas = []
    for command in ("joint_velocity", "joint_position", "joint_velocity"):
        actor, env = untrained(f"env.robot.command={command}")
        schemas.append([argument.name for argument in script(make_deployable(actor, env)).forward.schema.arguments[1:]])
        env.close()
    assert schemas[0] == schemas[2] == ["joint_position", "joint_velocity", "goal"]
    assert schemas[1] == [*schemas[0], "last_command"]


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
