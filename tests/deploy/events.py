"""What can happen to an arm under a controller: each function makes one tick of it, ``tick`` counts from zero."""

import dataclasses
import math

import numpy as np
import pytest

from physai.deploy import Goal, JointState
from physai.errors import UserError
from tests.deploy.configs import other_config
from tests.deploy.world import PERIOD


def well(world, rng, tick):
    world.flow(PERIOD, (rng.gauss(0, 1e-4), rng.gauss(0, 1e-4)))
    world.tick(PERIOD, world.report())


def jitter(world, rng, tick):
    elapsed = rng.uniform(0.01, 2.9) * PERIOD
    world.flow(elapsed)
    world.tick(elapsed, world.report())


def again_at_once(world, rng, tick):
    if tick % 3:
        world.tick(0.0)
    else:
        well(world, rng, tick)


def clock_stands_still(world, rng, tick):
    world.flow(PERIOD)
    world.tick(0.0, world.message() if rng.random() < 0.8 else None)


def silence(world, rng, tick):
    world.flow(PERIOD)
    world.tick()


def sends(make, verdict=None):
    """One message, which now and then comes after another that is as it should be."""

    def happen(world, rng, tick):
        world.flow(PERIOD / 2)
        first = [world.message()] if not verdict and rng.random() < 0.1 else []
        world.flow(PERIOD / 2)
        message = world.message(**make(world, rng))
        world.tick(PERIOD, [*first, message] if first else message, verdict=verdict)

    return happen


def gripper(rng):
    """Something else on the same topic, which is of no concern whatever it says."""
    position, stamp = rng.choice(((0.1, 0.2), (math.nan,) * 2, ("open",))), rng.choice((0.0, 1e9, math.nan))
    return JointState(("finger", "thumb"), position, (), stamp, None, (1e9, 1e9), "gripper")


def gripper_alone(world, rng, tick):
    world.flow(PERIOD)
    world.tick(PERIOD, rng.choice((gripper(rng), [gripper(rng)] * 2, [])))


def gripper_beside(world, rng, tick):
    world.flow(PERIOD)
    report = world.report()
    ours = report if isinstance(report, list) else [report]
    world.tick(PERIOD, rng.choice(([gripper(rng), *ours], [*ours, gripper(rng), gripper(rng)])))


def parts_in_turn(world, rng, tick):
    world.flow(PERIOD)
    world.tick(PERIOD, world.part(tick % 2))


def parts_at_once(world, rng, tick):
    world.flow(PERIOD)
    world.tick(PERIOD, rng.choice(([world.part(0), world.part(1)], [world.part(1), world.part(0)])))


def one_joint_of_two(world, rng, tick):
    if not tick:
        world.turn = rng.randrange(2)
    world.flow(PERIOD)
    world.tick(PERIOD, world.part(world.turn))


def several_at_once(world, rng, tick):
    """As after a moment in which the robot was not listened to; some of it may be unfit."""
    states = []
    for _ in range(rng.randrange(1, 4)):
        world.flow(PERIOD / 2)
        states.append(world.message(**rng.choice(({}, {}, {}, {"velocity": ()}, offset(world, rng)))))
    world.tick(len(states) * PERIOD / 2, states)


def another_source(world, rng, tick):
    if not tick:
        world.source = rng.choice(("a", "b", "c", None))
    well(world, rng, tick)


def long_silence(world, rng, tick):
    """And it may be somewhere else afterwards."""
    if not tick and rng.random() < 0.5:
        world.position = anywhere(world, rng)
    silence(world, rng, tick)


# Drives and sensors that are not what they should be.


def drives(*factors_and_biases):
    """The drives of a joint, or of both, make another velocity of a command."""

    def happen(world, rng, tick):
        if not tick:
            world.broken = rng.choice(((0,), (1,), (0, 1))), *rng.choice(factors_and_biases)
        world.broken_drives = world.broken
        well(world, rng, tick)

    return happen


def encoder_stuck(world, rng, tick):
    if not tick:
        world.broken = rng.randrange(2), list(world.position)
    joint, stuck = world.broken
    world.flow(PERIOD)
    world.tick(PERIOD, world.message(position=[stuck[j] if j == joint else q for j, q in enumerate(world.position)]))


def encoder_late(world, rng, tick):
    """By as much as may be, or by more than that."""
    if not tick:
        world.broken = [world.position] * rng.choice((3, 6, 15))
    world.flow(PERIOD)
    world.broken = [*world.broken[1:], world.position]
    world.tick(PERIOD, world.message(position=world.broken[0]))


def velocities_inconsistent(world, rng, tick):
    if not tick:
        factor, bias = rng.choice(((-1.0, 0.0), (57.3, 0.0), (1.0, 0.5), (1.0, -0.25), (1.0, 0.24)))
        world.broken = rng.choice(((0,), (1,), (0, 1))), factor, bias
    joints, factor, bias = world.broken
    world.flow(PERIOD)
    shown = [factor * v + bias if joint in joints else v for joint, v in enumerate(world.velocity)]
    world.tick(PERIOD, world.message(velocity=[min(7.5, max(-7.5, v)) for v in shown]))


def velocity_missing_at_times(world, rng, tick):
    world.flow(PERIOD)
    world.tick(PERIOD, world.message(velocity=(math.nan, 0.0) if tick % 2 else None))


def effort(*choices):
    def happen(world, rng, tick):
        if not tick:
            world.broken = rng.choice(choices)
        world.flow(PERIOD)
        world.tick(PERIOD, world.message(effort=world.broken))

    return happen


def efforts_in_turn(world, rng, tick):
    """Now the one joint, now the other is beyond its limit, neither for long."""
    world.flow(PERIOD)
    world.tick(PERIOD, world.message(effort=(5.1, 0.0) if tick % 4 < 2 else (0.0, -3.1)))


def offset(world, rng):
    q = list(world.position)
    q[rng.randrange(2)] += rng.choice((-1, 1)) * rng.uniform(0.2, 5.0)
    return {"position": q}


def counted_to_half_a_turn(world, rng, tick):
    """As drivers do that know no turns; the first joint goes to and fro where it jumps from one half to the other."""
    if not tick:
        world.position = [rng.choice((-1, 1)) * rng.uniform(3.1, 3.14), rng.uniform(-2, 2)]
    world.flow(PERIOD)
    world.position[0] = math.remainder(world.position[0], math.tau)
    onward = np.array([math.copysign(2.0, world.position[0]), 0.0])
    world.policy.trouble = lambda command: onward
    world.tick(PERIOD, world.message())


def teleport(place):
    def happen(world, rng, tick):
        world.flow(PERIOD)
        if not tick:
            world.position = place(world, rng)
        world.tick(PERIOD, world.message())

    return happen


def at_limit(low, high):
    def place(world, rng):
        return [rng.uniform(-9, 9), rng.choice((-1, 1)) * (world.upper[1] + rng.uniform(low, high))]

    return place


def anywhere(world, rng):
    return [rng.uniform(-6, 6), rng.uniform(-2.5, 2.5)]


def troubled(*troubles):
    def happen(world, rng, tick):
        if not tick:
            trouble = rng.choice(troubles)
            world.policy.trouble = trouble(rng) if callable(trouble) else trouble
        well(world, rng, tick)

    return happen


def push(rng):
    vector = np.array([rng.choice((-2.0, 2.0)), rng.choice((-2.0, 0.0, 2.0))])
    return lambda command: vector


def shake(rng):
    phase = rng.uniform(0, 6)
    return lambda command: 3 * np.sin(1e5 * command.astype(float) + phase)


def idle(rng):
    share = rng.choice((0.0, 1e-3, -1.0))
    return lambda command: command * share


def to_and_fro_at_limit(world, rng, tick):
    """Into the margin, back, and in again."""
    if not tick:
        world.position = at_limit(-0.15, -0.126)(world, rng)
    if not tick % 10:
        outward = np.sign(world.position) * rng.choice((2.0, 2.0, -2.0))
        world.policy.trouble = lambda command: outward
    well(world, rng, tick)


def dragged_beyond_a_limit(world, rng, tick):
    """And back, again and again, while the other joint moves as fast as it may."""
    if not tick:
        world.position = at_limit(-0.01, -0.01)(world, rng)
        onward = np.array([rng.choice((-2.0, 2.0)), 0.0])
        world.policy.trouble = lambda command: onward
    if tick >= 20 and not tick % 5:
        world.position = [world.position[0], math.copysign(2.61 if tick % 10 else 2.59, world.position[1])]
    well(world, rng, tick)


def clock(step):
    def happen(world, rng, tick):
        world.flow(PERIOD)
        world.tick(step(rng), world.message() if rng.random() < 0.7 else None)

    return happen


def late(world, rng, tick):
    elapsed = rng.uniform(3.05 * PERIOD, 0.95)
    world.flow(elapsed)
    world.tick(elapsed, world.message() if rng.random() < 0.8 else None)


def goal(make):
    def happen(world, rng, tick):
        world.flow(PERIOD)
        world.tick(PERIOD, world.message(), Goal(*make(rng)))

    return happen


def goal_again(world, rng, tick):
    """The arm drifts, and the goal is said again: exactly, or about."""
    world.flow(PERIOD, (rng.gauss(0, 1e-2), rng.gauss(0, 1e-2)))
    aside = rng.choice((0.0, 0.002, 0.01))
    about = [number + rng.uniform(-aside, aside) for number in world.goal or ()]
    world.tick(PERIOD, world.message(), Goal(about, "base") if about else None)


def on_ring(rng, low=0.3001, high=0.5299):
    radius, angle = rng.uniform(low, high), rng.uniform(-math.pi, math.pi)
    return [radius * math.cos(angle), radius * math.sin(angle)], "base"


def emergency(world, rng, tick):
    if not tick:
        world.emergency_stop()
    well(world, rng, tick)


def reset(world, rng, tick):
    if not tick:
        world.reset()
    well(world, rng, tick)


def forget_goal(world, rng, tick):
    if not tick:
        world.forget_goal()
    well(world, rng, tick)


def interlocked(world, rng, tick):
    """With all that may come in meanwhile."""
    world.flow(PERIOD, (rng.gauss(0, 1e-3), 0.0))
    state = world.message() if rng.random() < 0.9 else None
    new = Goal(*on_ring(rng)) if rng.random() < 0.1 else None
    world.tick(PERIOD, state, new, interlocks=rng.choice((("not enabled",), ["not enabled", "a person is near"])))


def configured(world, rng, tick):
    if not tick:
        world.configure(other_config(rng))
    well(world, rng, tick)


def configured_wrongly(world, rng, tick):
    """What is refused changes nothing, as the ticks that follow show."""
    bad = rng.choice(({"max_velocity": 2.6}, {"clock_jump": 0.05}, {"limit_margin": 2.7}, {"state_timeout": 10.0}))
    with pytest.raises(UserError):
        world.controller.configure(dataclasses.replace(other_config(rng), **bad))
    well(world, rng, tick)
