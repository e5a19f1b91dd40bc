"""The controller of legs: it stands up, walks, stands without a command, and gives way in a fault."""

import math
import random

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physai.deploy import Controller, ControllerConfig, Goal, Imu, JointState, State, make_controller
from physai.errors import UserError
from tests.deploy.legs import AHEAD, PERIOD, Legs

LYING = tuple(Rotation.from_euler("x", 1.2).as_quat())


@pytest.fixture
def legs(walking_policy):
    made = Legs(walking_policy)
    yield made
    made.physics.close()


def gives_way(legs, state):
    """Each joint is told to be where it is."""
    for _ in range(5):
        command = legs.tick()
        assert command.state is state
        np.testing.assert_array_equal(command.value, legs.controller._robot.position)


def test_it_stands_up_where_it_is_and_then_walks_as_it_is_told(legs):
    rising = legs.ticks(45, goal=AHEAD)
    assert {command.state for command in rising} == {State.ACTIVE}
    assert abs(legs.true.pose[0]) < 0.15
    start = legs.true.pose[0]
    commands = legs.ticks(250, goal=AHEAD)
    assert all(command.state is State.ACTIVE for command in commands)
    assert 1.5 < legs.true.pose[0] - start < 3.0
    assert legs.true.pose[2] > 0.22


def test_it_turns_to_the_left_as_it_is_told(legs):
    legs.ticks(200, goal=(0.4, 0.0, 0.5))
    yaw = Rotation.from_quat(legs.true.pose[3:]).as_euler("ZYX")[0]
    assert 0.8 < yaw < 2.2


@pytest.mark.fault("no velocity command for `command_timeout` (0.5 s)")
def test_without_a_fresh_command_it_stands_and_goes_on_with_the_next(legs):
    legs.walk()
    commands = legs.ticks(100)
    assert all(command.state is State.ACTIVE for command in commands)
    assert commands[-1].reasons[0].startswith("the last command is 2.0 s old: it stands")
    assert np.hypot(*legs.true.velocity[:2]) < 0.05
    legs.walk()
    assert legs.true.velocity[0] > 0.2


@pytest.mark.fault("a command faster than the policy was trained for")
def test_a_command_faster_than_it_has_learned_counts_as_the_fastest(legs):
    legs.walk()
    legs.tick(goal=(3.0, 0.0, -9.0))
    assert legs.controller.snapshot()["goal"] == [0.8, 0.0, -0.5]
    assert legs.counters["goals projected"] == 1


@pytest.mark.parametrize("goal", [Goal([math.nan, 0, 0], "trunk"), Goal([0.5, 0], "trunk"), Goal([0.5, 0, 0], "map")])
def test_a_command_that_is_none_is_refused_and_the_last_one_stays(legs, goal):
    legs.walk()
    command = legs.controller.update(legs.now + PERIOD, legs.state(stamp=legs.now + PERIOD), goal)
    assert command.state is State.ACTIVE
    assert command.reasons[0].startswith("goal rejected")
    assert legs.controller.snapshot()["goal"] == list(AHEAD)


@pytest.mark.fault("a reading older than `state_timeout` (0.1 s), or a joint state")
@pytest.mark.parametrize("silent", ["state", "imu"])
def test_in_a_hold_it_keeps_what_it_was_told_and_goes_on_when_it_is_heard_of_again(legs, silent):
    told = legs.walk().value
    commands = legs.ticks(9, goal=AHEAD, **{silent: None})
    held = [command for command in commands if command.state is State.HOLD]
    assert len(held) >= 3
    assert all(np.array_equal(command.value, held[0].value) for command in held)
    assert any(text in held[-1].reasons[0] for text in ("the last joint state is", "the last reading of the IMU is"))
    assert np.abs(held[0].value - told).max() < 0.7  # rad: no farther than the gait swings in as many steps
    assert [command.state for command in legs.ticks(8, goal=AHEAD)][-3:] == [State.ACTIVE] * 3


@pytest.mark.slow
@pytest.mark.parametrize("what", ["late", "slow", "silent", "interlock"])
def test_after_a_moment_in_which_it_kept_its_stance_it_walks_on_and_does_not_fall(walking_policy, what):
    """It is interrupted in each part of its gait."""
    for phase in range(0, 25, 2):
        legs = Legs(walking_policy)
        legs.walk(80 + phase)
        if what == "late":
            legs.pass_by(19)
        elif what == "slow":
            legs.policy.trouble = "slow"
            assert "ms" in legs.tick(goal=AHEAD).reasons[0]
            legs.policy.trouble = None
        else:
            legs.ticks(9, goal=AHEAD, **({"state": None} if what == "silent" else {"interlocks": ["not enabled"]}))
        commands = legs.ticks(100, goal=AHEAD)
        assert not any("it stands up" in command.reasons for command in commands)
        assert commands[-1].state is State.ACTIVE
        assert legs.true.velocity[0] > 0.2
        legs.physics.close()


@pytest.mark.slow
@pytest.mark.fault("a doubt in the midst of a walk that lasts for more than 0.2 s")
def test_in_a_longer_doubt_in_the_midst_of_its_walk_it_sinks_down_upright_and_stands_up_afterwards(walking_policy):
    """In each part of its gait, as in the test before; its stance alone would topple it in two of five."""
    for phase in range(0, 25, 3):
        legs = Legs(walking_policy)
        legs.walk(80 + phase)
        commands = []
        for _ in range(60):
            commands.append(legs.tick(goal=AHEAD, interlocks=["not enabled"]))
            sinks = any("it sinks down" in reason for reason in commands[-1].reasons)
            assert sinks == (len(commands) > 10) or len(commands) == 10  # 0.2 s
            stance = legs.controller._robot.position if sinks else commands[0].value
            np.testing.assert_array_equal(commands[-1].value, stance)
        assert {command.state for command in commands} == {State.WAITING}
        assert legs.true.pose[2] < 0.2
        commands = legs.ticks(150, goal=AHEAD)
        assert {command.state for command in commands} == {State.ACTIVE}
        assert "it stands up" in commands[0].reasons
        assert legs.true.velocity[0] > 0.2
        legs.physics.close()


def test_a_doubt_after_a_long_silence_of_whoever_asks_makes_it_sink_at_once(legs):
    legs.walk()
    legs.pass_by(14)
    first, second = legs.ticks(2, goal=AHEAD, interlocks=["not enabled"])
    np.testing.assert_array_equal(second.value, legs.controller._robot.position)
    assert not np.array_equal(first.value, second.value)


def test_one_that_stood_keeps_its_stance_and_after_a_longer_pause_it_stands_up_first(legs):
    legs.walk()
    legs.ticks(100)  # it stands
    kept = [command.value for command in legs.ticks(60, goal=AHEAD, interlocks=["not enabled"])]
    np.testing.assert_array_equal(kept, [kept[0]] * len(kept))
    assert all("it stands up" in command.reasons for command in legs.ticks(45, goal=AHEAD))


def test_a_policy_that_fails_on_and_on_does_not_make_a_pause_shorter(legs):
    legs.controller.configure(ControllerConfig(policy_failures=100))
    legs.walk()
    legs.ticks(100)  # it stands
    legs.policy.trouble = "slow"
    legs.ticks(30)
    legs.policy.trouble = None
    assert all("it stands up" in command.reasons for command in legs.ticks(45, goal=AHEAD))


def stopped(legs):
    legs.controller.emergency_stop()
    legs.ticks(3)
    legs.controller.reset()


def stopped_and_reset_at_once(legs):
    legs.controller.emergency_stop()
    legs.controller.reset()


def heard_of_by_another(legs):
    for source in ("one", "another"):
        legs.tick(goal=AHEAD, state=legs.state(stamp=legs.now + PERIOD, source=source))


def not_sent_and_interlocked(legs):
    legs.controller.not_sent()
    legs.ticks(2, interlocks=["not enabled"])


def taken_over(legs):
    legs.controller.forget_goal()
    legs.ticks(2, interlocks=["another publisher"])


def with_a_clock_set_back(legs):
    legs.now -= 0.3
    legs.ticks(20, interlocks=["not enabled"])  # which seem to be 0.1 s


@pytest.mark.parametrize(
    "after",
    [
        stopped,
        stopped_and_reset_at_once,
        heard_of_by_another,
        not_sent_and_interlocked,
        taken_over,
        with_a_clock_set_back,
    ],
)
def test_where_its_stance_is_that_of_its_walk_no_more_it_stands_up_first(legs, after):
    """However short the pause was."""
    legs.walk()
    after(legs)
    commands = [command for command in legs.ticks(14, goal=AHEAD) if command.state is State.ACTIVE]
    assert len(commands) > 5
    assert all("it stands up" in command.reasons for command in commands)


@pytest.mark.fault("the base leans by more than `max_tilt` (0.8 rad)")
def test_to_lean_too_far_is_a_fault_in_which_the_joints_only_damp(legs):
    legs.walk()
    command = legs.tick(imu=legs.imu(orientation=LYING, stamp=legs.now + PERIOD))
    assert command.state is State.FAULT
    assert command.reasons == ("the base leans by 1.20 rad",)
    gives_way(legs, State.FAULT)
    height = legs.true.pose[2]
    legs.ticks(100)
    assert legs.true.pose[2] < height - 0.05  # it has sunk
    assert np.abs(legs.true.speed).max() < 3.0


@pytest.mark.fault("FAULT or ESTOP")
def test_an_emergency_stop_lets_it_sink_and_after_a_reset_only_a_new_command_moves_it(legs):
    legs.walk()
    legs.controller.emergency_stop()
    gives_way(legs, State.ESTOP)
    legs.ticks(50)
    assert legs.controller.reset()
    commands = legs.ticks(20)
    assert [command.state for command in commands[:4]] == [State.HOLD] * 4
    assert commands[-1].state is State.WAITING
    assert commands[-1].reasons == ("no goal yet",)
    assert np.array_equal(commands[-1].value, commands[0].value)
    legs.ticks(200, goal=AHEAD)
    assert legs.true.velocity[0] > 0.2  # it stood up again


@pytest.mark.fault("a stance that was not sent, or a robot that was silent")
def test_a_stance_that_was_not_sent_is_forgotten_for_others_may_have_moved_the_robot(legs):
    before = legs.ticks(3)[-1].value
    for _ in range(2):
        legs.physics.step(before[None] - 0.3)
    np.testing.assert_array_equal(legs.tick().value, before)
    legs.controller.not_sent()
    legs.now += PERIOD
    command = legs.controller.update(legs.now, legs.state(), None, (), legs.imu())
    np.testing.assert_array_equal(command.value, legs.true.position)


def test_another_rise_time_does_not_pull_it_back_in_the_midst_of_its_walk(legs):
    told = legs.walk().value
    legs.controller.configure(ControllerConfig(rise_time=60.0))
    command = legs.tick(goal=AHEAD)
    assert command.reasons == ()
    assert np.abs(command.value - told).max() < 0.4


def test_what_came_before_the_clock_was_set_back_is_not_fresh(legs):
    legs.walk()
    legs.now -= 10.0
    assert {command.state for command in legs.ticks(20, imu=None)} == {State.HOLD}
    command = legs.ticks(8)[-1]
    assert command.state is State.ACTIVE
    assert command.reasons[0].startswith("the last command is -9.")


@pytest.mark.fault("no reading of the IMU yet")
def test_it_waits_for_the_first_reading_of_the_imu(legs):
    command = legs.ticks(3, goal=AHEAD, imu=None)[-1]
    assert command.state is State.WAITING
    assert command.reasons == ("no reading of the IMU yet",)
    assert legs.tick(goal=AHEAD).state is State.ACTIVE


def test_a_policy_that_fails_three_times_is_a_fault(legs):
    legs.walk()
    legs.policy.trouble = "nan"
    assert [command.state for command in legs.ticks(3, goal=AHEAD)][-1] is State.FAULT
    gives_way(legs, State.FAULT)


def test_who_asks_twice_as_often_gets_the_same_walk(walking_policy):
    once, twice = Legs(walking_policy), Legs(walking_policy)
    asked = []
    for legs, count in ((once, 1), (twice, 2)):
        for _ in range(50):
            legs.physics.step(legs.told[None])
            for _ in range(count):
                legs.now += PERIOD / count
                goal, state = Goal(AHEAD, "trunk"), legs.state()
                legs.told = legs.controller.update(legs.now, state, goal, (), legs.imu()).value
        asked.append(legs.true.pose)
        legs.physics.close()
    np.testing.assert_allclose(asked[0], asked[1], atol=0.02)


def test_an_arm_s_controller_refuses_it_by_name(walking_policy):
    with pytest.raises(UserError, match="the policy takes 'angular_velocity': this controller can tell joint_position"):
        Controller(walking_policy)


READINGS = {
    "nan": lambda imu, rng: {"angular_velocity": (math.nan, 0.0, 0.0)},
    "no rotation": lambda imu, rng: {"orientation": (0.0, 0.0, 0.0, rng.choice((0.0, 0.5, math.inf)))},
    "frozen": lambda imu, rng: {"stamp": 1.0},
    "behind": lambda imu, rng: {"stamp": imu.stamp - 1.0},
    "delayed": lambda imu, rng: {"received": imu.stamp - rng.uniform(0.0, 0.3)},
    "another frame": lambda imu, rng: {"frame": "imu_link"},
    "spinning": lambda imu, rng: {"angular_velocity": (0.0, 99.0, 0.0)},
    "leaning": lambda imu, rng: {"orientation": tuple(Rotation.from_euler("y", rng.uniform(-3, 3)).as_quat())},
    "too short": lambda imu, rng: {"orientation": (0.0, 1.0)},
}


@pytest.mark.fault(
    "a reading with a number that is not finite, with a quaternion that is no rotation, in another frame"
)
@pytest.mark.fault("a stamp of the IMU that is repeated or runs backwards, more than 40 rad/s")
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_whatever_its_sensors_say_the_contract_is_kept(walking_policy, seed):
    """10,000 updates of a robot whose sensors fail, at random: what is sent, and when it may walk."""
    rng, metadata = random.Random(seed), walking_policy.metadata
    config = ControllerConfig(command_timeout=0.3, rise_time=0.2)
    controller, seen = make_controller(walking_policy, config), set()
    position, now, heard, felt, tilt, commanded = metadata.home.copy(), 100.0, -math.inf, -math.inf, 0.0, -math.inf
    trouble, left = None, 0
    low, high = metadata.command.bounds
    before, stamp = None, -math.inf
    for _ in range(10_000):
        left -= 1
        if left < 0:
            fails = rng.random() < 0.3
            trouble = rng.choice([*READINGS, "no state", "no imu"]) if fails else None
            left = rng.choice((1, 2, 10)) if fails else 20
        now += PERIOD
        position = np.clip(position + np.array([rng.uniform(-0.02, 0.02) for _ in position]), low, high)
        state = JointState(metadata.joints, position, np.zeros(len(position)), now)
        orientation = Rotation.from_euler("xyz", [rng.uniform(-0.3, 0.3) for _ in range(3)]).as_quat()
        imu = Imu(tuple(orientation), tuple(rng.uniform(-1, 1) for _ in range(3)), now, metadata.goal.frame)
        if trouble in READINGS:
            imu = Imu(**vars(imu) | READINGS[trouble](imu, rng))
        if trouble in (None, "no state", "delayed", "leaning", "behind", "frozen"):
            if imu.stamp > stamp:
                x, y, _, _ = imu.orientation
                felt, tilt = imu.received or now, math.acos(np.clip(1 - 2 * (x * x + y * y), -1, 1))
            stamp = imu.stamp
        heard = heard if trouble == "no state" else now
        goal = Goal([rng.uniform(0, 1), 0.0, rng.uniform(-1, 1)], metadata.goal.frame) if rng.random() < 0.2 else None
        commanded = commanded if goal is None else now
        if rng.random() < 0.02:
            controller.reset()
        if rng.random() < 0.001:
            controller.emergency_stop()
        command = controller.update(
            now, None if trouble == "no state" else state, goal, (), None if trouble == "no imu" else imu
        )
        seen.add(command.state)
        assert command.value is not None
        assert np.isfinite(command.value).all()
        if command.state is State.ACTIVE:
            assert now - heard <= config.state_timeout
            assert now - felt <= config.state_timeout + 1e-9
            assert tilt <= config.max_tilt
            assert (command.value >= low - 1e-9).all()
            assert (command.value <= high + 1e-9).all()
            if now - commanded > config.command_timeout:
                assert any("it stands" in reason for reason in command.reasons)
        elif command.state in (State.FAULT, State.ESTOP) or any("it sinks down" in one for one in command.reasons):
            np.testing.assert_array_equal(command.value, controller._robot.position)
        elif before is not None and before.state is command.state:  # a HOLD or a wait keeps what was told
            np.testing.assert_array_equal(command.value, before.value)
        before = command
    assert seen == {State.ACTIVE, State.HOLD, State.FAULT, State.ESTOP, State.WAITING}
    counters = controller.snapshot()["counters"]
    for kind in ("not finite", "not a rotation", "stamp", "wrong frame", "implausible", "malformed"):
        assert counters[f"IMU readings rejected: {kind}"] >= 10, kind
    assert counters["faults: orientation"] >= 10
    assert counters["holds: IMU old"] >= 20
