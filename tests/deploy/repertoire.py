"""All that can happen to an arm under a controller, by name, and for how long it usually lasts."""

import math

from tests.deploy.events import (
    again_at_once,
    another_source,
    anywhere,
    at_limit,
    clock,
    clock_stands_still,
    configured,
    configured_wrongly,
    counted_to_half_a_turn,
    dragged_beyond_a_limit,
    drives,
    effort,
    efforts_in_turn,
    emergency,
    encoder_late,
    encoder_stuck,
    forget_goal,
    goal,
    goal_again,
    gripper_alone,
    gripper_beside,
    idle,
    interlocked,
    jitter,
    late,
    long_silence,
    offset,
    on_ring,
    one_joint_of_two,
    parts_at_once,
    parts_in_turn,
    push,
    reset,
    sends,
    several_at_once,
    shake,
    silence,
    teleport,
    to_and_fro_at_limit,
    troubled,
    velocities_inconsistent,
    velocity_missing_at_times,
    well,
)
from tests.deploy.troubled import ALL_FAILURES
from tests.deploy.world import NAMES, PERIOD

TOO_STRONG = ((5.1, 0.0), (0.0, -3.1), (-1e9, math.nan), (math.nan, math.inf))
NOT_FINITE = (math.nan, math.inf, -math.inf)
NO_STATES = [
    *({"names": bad} for bad in (None, 7, (["joint1"], "joint2"))),
    *({key: bad} for key in ("position", "velocity") for bad in (("0.1", "0.2"), (None, 0.1), (10**400, 0.1), 0.1)),
    *({"stamp": bad} for bad in ("now", (), 10**400)),
]


def reset_with_goal(world, rng, tick):
    if not tick:
        world.reset()
    EVENTS["goal" if tick == 1 else "well"](world, rng, tick)


EVENTS = {
    "well": well,
    "jitter": jitter,
    "updates three at a time": again_at_once,
    "clock stands still": clock_stands_still,
    "no state": silence,
    "old on arrival": sends(lambda w, rng: {"received": w.now + PERIOD - rng.uniform(0.11, 5.0)}),
    "some age on arrival": sends(lambda w, rng: {"received": w.now + PERIOD - rng.uniform(0.0, 0.09)}),
    "from the future": sends(lambda w, rng: {"received": w.now + rng.uniform(0.1, 5.0)}),
    "reordered": sends(
        lambda w, rng: {"names": NAMES[::-1], "position": w.position[::-1], "velocity": w.velocity[::-1]}
    ),
    "extra joints": sends(
        lambda w, rng: {
            "names": ("x", "joint2", "joint1"),
            "position": (rng.choice(NOT_FINITE), *w.position[::-1]),
            "velocity": (9e9, *w.velocity[::-1]),
        }
    ),
    "another joint instead": sends(
        lambda w, rng: {"names": rng.choice((("joint1", "x"), ("x", "joint2"), ("joint1",), ("x",), ("x", "y")))}
    ),
    "a gripper alone": gripper_alone,
    "a gripper beside": gripper_beside,
    "states in parts in turn": parts_in_turn,
    "states in parts at once": parts_at_once,
    "one joint of two": one_joint_of_two,
    "several states at once": several_at_once,
    "another source": another_source,
    "long silence": long_silence,
    "drive off": drives((0.0, 0.0)),
    "drive of wrong sign": drives((-1.0, 0.0)),
    "drive slow or fast": drives(*((share, 0.0) for share in (0.4, 0.65, 0.75, 1.25, 1.35, 2.0))),
    "drive moves by itself": drives(*((1.0, more) for more in (-0.2, -0.05, 0.03, 0.2))),
    "encoder stuck": encoder_stuck,
    "encoder late": encoder_late,
    "velocities inconsistent": velocities_inconsistent,
    "velocity missing at times": velocity_missing_at_times,
    "effort": effort((4.9, -2.9), (math.nan, 0.0), (0.0, 0.0)),
    "effort beyond its limit": effort(*TOO_STRONG),
    "effort beyond its limit for long": effort(*TOO_STRONG),
    "efforts beyond their limits in turn": efforts_in_turn,
    "effort of wrong size": sends(lambda w, rng: {"effort": [0.1] * rng.choice((1, 3))}),
    "duplicate name": sends(lambda w, rng: {"names": rng.choice((("joint1", "joint1"), (*NAMES, "joint2")))}),
    "lengths disagree": sends(lambda w, rng: {rng.choice(("position", "velocity")): [0.1] * rng.choice((1, 3))}),
    "position not finite": sends(
        lambda w, rng: {"position": rng.choice(([rng.choice(NOT_FINITE), 0.0], [0.0, math.nan]))}
    ),
    "velocity missing": sends(
        lambda w, rng: {"velocity": rng.choice(((), [math.nan, 0.0], [0.0, math.inf], [math.nan] * 2))}
    ),
    "no lists of numbers": sends(lambda w, rng: rng.choice(NO_STATES), "malformed"),
    "velocity implausible": sends(lambda w, rng: {"velocity": rng.choice(([7.6, 0.0], [0.0, -1e9]))}),
    "position jump": sends(offset),
    "stamp backwards": sends(lambda w, rng: {"stamp": w.stamp - rng.choice((PERIOD + 1e-3, 1.0, 1e6))}),
    "stamp repeated": sends(lambda w, rng: {"stamp": w.told[0][1] if w.told[0] else 0.0}),
    "stamp not finite": sends(lambda w, rng: {"stamp": rng.choice(NOT_FINITE)}),
    "stamp ahead": sends(lambda w, rng: {"stamp": w.stamp + rng.choice((0.05, 1.0))}),
    "stamp ahead and position jump": sends(
        lambda w, rng: {"stamp": w.stamp + rng.choice((0.1, 1.0, 3600.0)), **offset(w, rng)}
    ),
    "counted to half a turn": counted_to_half_a_turn,
    "arm elsewhere": teleport(anywhere),
    "arm in a margin": teleport(at_limit(-0.12, 0.0)),
    "arm beyond a limit": teleport(at_limit(0.0, 0.15)),
    "arm far beyond a limit": teleport(at_limit(0.25, 1.0)),
    "goal": goal(on_ring),
    "goal again": goal_again,
    "goal not finite": goal(lambda rng: ([rng.choice((*NOT_FINITE, 1.7e308)), rng.choice((0.4, 1.7e308))], "base")),
    "goal of wrong size": goal(lambda rng: ([0.4] * rng.choice((0, 1, 3)), "base")),
    "goal in wrong frame": goal(lambda rng: (on_ring(rng)[0], "world")),
    "goal too far": goal(lambda rng: on_ring(rng, 0.54, 100.0)),
    "goal too near": goal(lambda rng: on_ring(rng, 0.0, 0.29)),
    "policy fails": troubled(*ALL_FAILURES),
    "emergency stop in the policy": troubled("emergency stop"),
    "policy beyond its range": troubled(lambda rng: lambda command: command * 1e3),
    "policy pushes outward": troubled(push),
    "policy shakes": troubled(shake),
    "policy makes no progress": troubled(idle),
    "policy to and fro at a limit": to_and_fro_at_limit,
    "arm dragged beyond a limit": dragged_beyond_a_limit,
    "late": late,
    "clock back": clock(lambda rng: -rng.choice((1e-3, PERIOD, 1.0, 500.0))),
    "clock ahead": clock(lambda rng: rng.choice((1.01, 60.0, 1e6))),
    "clock not finite": clock(lambda rng: rng.choice(NOT_FINITE)),
    "emergency stop": emergency,
    "reset": reset,
    "reset, then a goal": reset_with_goal,
    "goal forgotten": forget_goal,
    "interlocked": interlocked,
    "configured": configured,
    "configured wrongly": configured_wrongly,
}
LENGTHS = {
    "policy pushes outward": 300,
    "policy shakes": 100,
    "policy makes no progress": 120,
    "arm dragged beyond a limit": 80,
    "effort beyond its limit for long": 40,
    "efforts beyond their limits in turn": 40,
    "one joint of two": 10,
    "long silence": 60,
    "drive off": 40,
    "drive of wrong sign": 40,
    "drive slow or fast": 80,
    "drive moves by itself": 60,
    "encoder stuck": 50,
    "encoder late": 80,
    "velocities inconsistent": 50,
    "velocity missing at times": 60,
    "policy to and fro at a limit": 300,
    "counted to half a turn": 120,
    "arm in a margin": 50,
    "arm beyond a limit": 100,
    "reset": 1,
    "goal forgotten": 1,
    "configured wrongly": 1,
}
