"""What the inference node tells about itself, and how often it answers."""

import itertools
import math
import statistics
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from physai.deploy import load_policy
from physai.ros.topics.diagnostics import Timing
from tests.ros.loop import closed_loop
from tests.waiting import wait_for


def test_timing_knows_nothing_before_the_second_update():
    timing = Timing()
    assert timing.summary() == {"rate_hz": None, "jitter_ms": None}
    timing.tick(1.0)
    assert timing.summary() == {"rate_hz": None, "jitter_ms": None}
    timing.tick(1.02)
    assert timing.summary() == {"rate_hz": 50.0, "jitter_ms": 0.0}


def test_timing_looks_at_the_last_updates_only():
    timing = Timing(length=10)
    for i in range(10):
        timing.tick(i * 1.0)
    for i in range(11):
        timing.tick(10.0 + i * 0.1)
    assert timing.summary() == {"rate_hz": 10.0, "jitter_ms": pytest.approx(0.0, abs=1e-3)}
    timing.tick(11.0 + 0.2)
    assert timing.summary()["jitter_ms"] == pytest.approx(90.0)  # a period of 200 ms, where the mean is 110


@given(st.lists(st.floats(1e-3, 10.0), min_size=1, max_size=50))
def test_timing_gives_mean_rate_and_largest_deviation(periods):
    timing, now = Timing(length=100), 0.0
    timing.tick(now)
    for period in periods:
        now += period
        timing.tick(now)
    mean = statistics.fmean(periods)
    summary = timing.summary()
    assert summary["rate_hz"] == pytest.approx(1 / mean, rel=1e-6, abs=0.006)
    assert summary["jitter_ms"] == pytest.approx(1e3 * max(abs(p - mean) for p in periods), rel=1e-6, abs=0.002)


@pytest.mark.slow
@pytest.mark.realtime
def test_diagnostics_come_every_second_and_with_every_change(loop, policy_path):
    loop.rest()
    seen = len(loop.peer.diagnostics)
    wait_for(lambda: len(loop.peer.diagnostics) >= seen + 6)  # the first ones may be of a change
    times = [at for at, _ in loop.peer.diagnostics[seen + 2 :]]
    assert all(0.7 < b - a < 1.3 for a, b in itertools.pairwise(times)), times
    loop.start_from_here()
    changed, _ = loop.peer.wait_state("active")
    level, message, values = loop.diagnosis(after=changed - 0.05)
    assert level == 0
    assert message.startswith("active")
    assert values["policy_sha256"] == load_policy(policy_path).sha256
    assert values["enabled"] == "True"
    assert values["goal"] == "[-0.3, -0.2]"
    assert 0.0 <= float(values["joint_state_age"]) < 0.1
    wait_for(lambda: float(loop.diagnosis()[2]["rate_hz"]) > 45)
    values = loop.diagnosis()[2]
    assert 45 < float(values["rate_hz"]) < 55
    assert 0 <= float(values["jitter_ms"]) < 100
    before = int(values["count: updates"])
    assert before < int(loop.diagnosis()[2]["count: updates"]) < before + 200
    since = loop.arm.pause()
    held, _ = loop.peer.wait_state("hold", after=since)
    level, message, values = loop.diagnosis(after=held - 0.001)
    assert level == 1
    assert message.startswith("hold: the last joint state is 0.1")
    assert int(values["count: holds: state old"]) >= 1
    assert "joint state is 0.1" in values["last_hold"]
    loop.arm.go_home()
    loop.peer.wait_state("active")
    since = time.monotonic()
    loop.peer.emergency_stop()
    stopped, _ = loop.peer.wait_state("estop", after=since)
    level, message, values = loop.diagnosis(after=stopped - 0.001)
    assert (level, message) == (2, "estop: emergency stop")
    status = loop.peer.diagnostics[-1][1].status[0]
    assert (status.name, status.hardware_id) == ("inference_node: arm", "planar_arm")


@pytest.mark.realtime
@pytest.mark.slow
def test_with_the_joint_state_as_trigger_commands_answer_states(policy_path):
    with closed_loop(policy_path, rate=80.0, trigger="joint_state", goal=[-0.3, -0.2]) as loop:
        loop.peer.moved()
        since = time.monotonic()
        loop.peer.moved(after=since, commands=160)
        commands = [at for at, _ in loop.peer.commands if at > since]
        states = [at for at in loop.arm.sent if since < at < commands[-1]]
        # One for one, but for what is under way, and for states that came while the node still worked on one.
        assert 0.75 * len(states) < len(commands) <= len(states) + 15
        answers = [next((at for at in commands if at > sent), math.inf) - sent for sent in states[:-1]]
        assert statistics.median(answers) < 0.02
        for _ in range(3):
            since = loop.arm.pause()
            assert 0.08 < loop.peer.first_zeros(after=since) < 0.15
            loop.peer.all_zeros(after=since + 0.15)  # they come without states
            loop.arm.go_home()
            loop.peer.moved(after=time.monotonic())
