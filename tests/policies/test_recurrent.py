"""Policies that remember: step by step, and in sequences with the ends of episodes in them."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.policies import GRUActor, HistoryActor

ROWS, STEPS = 3, 7
UNITS, ACTIONS = 4, 2 * 2  # of the unit, and two past actions of two numbers each
SIZE = UNITS + ACTIONS


def make(kind):
    torch.manual_seed(0)
    own = {"memory_size": UNITS} if kind is GRUActor else {}
    actor = kind(3, 2, ["x"], [8], "torch.nn.Tanh", initial_std=0.7, past_actions=2, **own)
    with torch.no_grad():
        actor.network[-1].weight.normal_()  # it starts near standstill: make it move
    return actor


@pytest.fixture
def actor():
    return make(GRUActor)


@pytest.fixture
def sequences():
    """The second row begins an episode at step 3, the third at 0, 4 and 5."""
    length = torch.arange(5, 5 + STEPS).repeat(ROWS, 1)
    length[1, 3:] = torch.arange(4)
    length[2] = torch.tensor([0, 1, 2, 3, 0, 0, 1])
    memory = torch.randn(ROWS, STEPS, SIZE)  # of the unit, only the first counts
    memory[2, 0] = 0.0
    data = {"x": torch.randn(ROWS, STEPS, 3), "memory": memory, "episode_length": length[..., None]}
    return TensorDict(data, [ROWS, STEPS])


def by_hand(actor, x, memory):
    """One step of the unit for one row, after Cho et al."""
    cell = actor.cell
    of_x, of_memory = cell.weight_ih @ x + cell.bias_ih, cell.weight_hh @ memory + cell.bias_hh
    reset, update = torch.sigmoid(of_x[: 2 * UNITS] + of_memory[: 2 * UNITS]).split(UNITS)
    candidate = torch.tanh(of_x[2 * UNITS :] + reset * of_memory[2 * UNITS :])
    memory = (1 - update) * candidate + update * memory
    return memory, actor.network(torch.cat([x, memory]))


def test_a_sequence_is_what_single_steps_make_of_it_from_zero_wherever_an_episode_begins(actor, sequences):
    mean = actor.get_dist(sequences).mean
    for row in range(ROWS):
        memory = sequences["memory"][row, 0, :UNITS]
        for step in range(STEPS):
            if sequences["episode_length"][row, step] == 0:
                memory = torch.zeros(UNITS)
            seen = torch.cat([sequences["x"][row, step], sequences["memory"][row, step, UNITS:]])
            memory, expected = by_hand(actor, seen, memory)
            torch.testing.assert_close(mean[row, step], expected)


def test_what_it_learns_goes_back_through_an_episode_and_never_into_the_one_before(actor, sequences):
    sequences["x"].requires_grad_()
    actor.mean(sequences)[:, -1].sum().backward()
    told = sequences["x"].grad.abs().sum(-1) > 0
    assert told.tolist() == [[True] * 7, [False] * 3 + [True] * 4, [False] * 5 + [True] * 2]


def test_acting_writes_the_new_memory_and_draws_as_other_actors_do(actor):
    memory = torch.randn(64, SIZE)
    length = torch.full((64, 1), 9)
    with set_exploration_type(ExplorationType.RANDOM):
        data = actor(TensorDict({"x": torch.randn(64, 3), "memory": memory, "episode_length": length}, [64]))
    assert torch.equal(data["memory"], memory)
    seen = torch.cat([data["x"], memory[:, UNITS:]], dim=1)
    assert torch.equal(data["new_memory"][:, :UNITS], actor.cell(seen, memory[:, :UNITS]))
    torch.testing.assert_close(data["action_log_prob"], actor.get_dist(data).log_prob(data["latent_action"]))
    assert data["latent_action"].std() > 0.3


@pytest.mark.parametrize("kind", [GRUActor, HistoryActor])
def test_it_remembers_what_it_did_newest_first_exploration_included(kind):
    actor, done = make(kind), []
    memory = torch.zeros(5, actor.memory_size)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        for x in torch.randn(3, 5, 3):
            data = actor(TensorDict({"x": x, "memory": memory}, [5]))
            memory = data["new_memory"]
            done.insert(0, data["action"])
            assert memory.shape == (5, actor.memory_size)
            assert torch.equal(memory[:, actor.units :][:, : 2 * len(done)], torch.cat(done, dim=1)[:, :ACTIONS])
    sequence = TensorDict({"x": torch.randn(5, 1, 3), "memory": memory[:, None]}, [5, 1])
    sequence["episode_length"] = torch.ones(5, 1, 1)
    other = sequence.clone()
    other["memory"][..., -1] += 1.0
    assert (actor.mean(sequence) - actor.mean(other)).abs().min() > 1e-4


@pytest.mark.parametrize("kind", [GRUActor, HistoryActor])
def test_what_is_exported_acts_to_the_last_bit_as_the_actor_over_a_thousand_steps(kind):
    actor = make(kind)
    module = torch.jit.script(actor.deterministic())
    memory = mine = torch.zeros(1, actor.memory_size)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for x in torch.randn(1000, 1, 3):
            data = actor(TensorDict({"x": x, "memory": memory}, [1]))
            memory = data["new_memory"]
            action, mine = module(x, mine)
            assert torch.equal(action, data["action"])
    assert torch.equal(mine, memory)
    assert mine.abs().max() > 0.1
