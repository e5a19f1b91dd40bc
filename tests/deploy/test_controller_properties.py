"""What holds whatever happens: random sequences of states, goals, faults and times against a model of the contract."""

import random
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physai.deploy import Controller, State
from tests.deploy.configs import random_config
from tests.deploy.events import anywhere, well
from tests.deploy.repertoire import EVENTS, LENGTHS
from tests.deploy.troubled import Troubled
from tests.deploy.world import Analytic, World

WAYS = ("whole", "whole", "list", "alternating")


def drive(policies, seed, updates, log=None):
    """Let things happen to one world after another, of one policy after another, and return what was seen."""
    rng, names, seen = random.Random(seed), sorted(EVENTS), Counter()
    done = 0
    while done < updates:
        config, policy = random_config(rng), policies[done // 5000 % len(policies)]
        if log is not None:
            log.append(("new", policy, config))
        world = World(policy, config, anywhere(None, rng), log, rng.choice(WAYS))
        event, left = None, 0
        for tick in range(5000):
            chance = rng.random()
            if not left and chance < 0.025:
                name = rng.choice(names)
                left = LENGTHS.get(name) or rng.choice((1, 1, 2, 3, 6, 20))
                event, begun = EVENTS[name], tick
                seen[name] += 1
            elif world.latched and chance > 0.9:
                if rng.random() < 0.5:
                    world.position = anywhere(world, rng)
                world.reset()
            if left:
                left -= 1
                event(world, rng, tick - begun)
            elif chance > 0.99 or ((world.goal is None or world.gave_up) and chance > 0.9):
                EVENTS["goal"](world, rng, 0)
            else:
                world.policy.trouble = None
                well(world, rng, tick)
        done += 5000
        world.finish()
        seen += world.seen
    seen["updates"] = done
    return seen


SEEDS, UPDATES = range(2), 90_000  # one with velocities, one with positions


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_random_updates_keep_the_contract(policy, position_policy, seed):
    policy = (policy, position_policy)[seed % 2]
    # The real one needs twice the time, and what is tested is the controller.
    analytic = Analytic(policy.metadata)
    seen = drive([analytic] if seed else [policy, analytic, analytic], seed, UPDATES)
    assert seen["updates"] >= UPDATES
    assert seen["moving"] >= 0.6 * UPDATES
    for state in State:
        assert seen[state] >= 0.001 * UPDATES, state
    for event in EVENTS:
        assert seen[event] >= 5, event
    sights = ("at a limit", "beyond a limit", "held back", "goal projected", "goal rejected")
    states = ("good", "other", "malformed", "implausible")
    for sight in (*states, "holds", "interlocked", "around", *sights):
        assert seen[sight] >= 40, sight
    faults = (f"faults: {kind}" for kind in ("position", "policy", "following", "effort"))
    losses = ("goal forgotten", "goal forgotten after a silence", "holds: no progress")
    for sight in (*faults, *losses, "contradicted", "stopped at a limit", "slowed beyond a limit"):
        assert seen[sight] >= 3, sight
    if policy is position_policy:
        for sight in ("held near the arm", "stood elsewhere"):
            assert seen[sight] >= 40, sight


@pytest.mark.slow
@pytest.mark.parametrize("positions", [True, False], ids=["positions", "velocities"])
@pytest.mark.parametrize("real", [True, False], ids=["real", "analytic"])
def test_the_same_inputs_give_the_same_outputs_bit_for_bit(policy, position_policy, real, positions):
    policy, log = position_policy if positions else policy, []
    drive([policy if real else Analytic(policy.metadata)], 99, 5_000, log)
    assert sum(entry[0] == "update" for entry in log) >= 5_000
    for kind, *entry in log:
        if kind == "new":
            driver, config = entry
            troubled_policy = Troubled(driver)
            controller = Controller(troubled_policy, config, troubled_policy.stopwatch)
            troubled_policy.stop = controller.emergency_stop
        elif kind == "update":
            inputs, troubled_policy.trouble, *expected = entry
            command = controller.update(*inputs)
            velocity = None if command.value is None else command.value.tobytes()
            assert [velocity, command.state, command.reasons] == expected
        else:
            getattr(controller, kind)(*entry)


happenings = st.lists(
    st.tuples(st.sampled_from(list(EVENTS)), st.integers(1, 25), st.integers(0, 9)), min_size=1, max_size=40
)


@pytest.mark.slow
@settings(max_examples=600, deadline=None)
@given(st.sampled_from(range(6)), happenings, st.booleans(), st.booleans(), st.sampled_from(sorted(set(WAYS))))
def test_whatever_happens_in_whatever_order_the_contract_is_kept(
    policy, position_policy, world_seed, happened, known_goal, positions, way
):
    rng, driver = random.Random(world_seed), position_policy if positions else policy
    world = World(Analytic(driver.metadata), random_config(rng), anywhere(None, rng), way=way)
    if known_goal:
        EVENTS["goal"](world, rng, 0)
    for name, ticks, seed in happened:
        rng = random.Random(seed)
        world.policy.trouble = None
        for tick in range(ticks):
            EVENTS[name](world, rng, tick)
    world.finish()
