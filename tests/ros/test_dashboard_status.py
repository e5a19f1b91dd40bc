"""What people are told of a robot: words for each state of it, and for silence, without ROS or a browser."""

import numpy as np
import pytest

from physai.ros.live.status import Level, Status, stop_words

NOW = 1000.0


def robot(**known) -> Status:
    return Status(
        **{"namespace": "/arm1", "present": True, "since": 0.0, "state": "active", "words": "active", "told": NOW - 0.4}
        | known
    )


@pytest.mark.parametrize(
    ("known", "level", "words"),
    [
        ({}, Level.FINE, "ACTIVE"),
        ({"state": "fault", "words": "fault: stuck; slow"}, Level.ERROR, "FAULT: stuck; slow"),
        ({"state": "hold", "words": "hold: no joint states"}, Level.WARNING, "HOLD: no joint states"),
        ({"state": "estop", "words": "active"}, Level.ERROR, "ESTOP"),  # words travel more slowly
        ({"present": False, "since": NOW - 12}, Level.GONE, "GONE 12 s ago; its node is not there"),
        ({"told": NOW - 5}, Level.GONE, "SILENT: its last words, 5.0 s ago: active"),
        ({"state": ""}, Level.GONE, "it has not said anything yet"),
    ],
)
def test_one_line_says_what_a_robot_does_and_never_what_is_not_known_any_more(known, level, words):
    assert robot(**known).headline(NOW) == (level, words)


def test_details_say_how_old_things_are_and_count_trouble_alone():
    values = {"rate_hz": "50.0", "jitter_ms": "", "enabled": "True", "goal": "[0.3, -0.2]"}
    values |= {"count: late updates": "2", "count: updates": "900", "count: faults: stuck": "0"}
    told = dict(robot(values=values, rate=49.8, moved=NOW - 0.02, said="reset: done", said_at=NOW - 1).details(NOW))
    assert told == {
        "joint states": "50 Hz, the last 0.0 s ago",
        "told of itself": "0.4 s ago",
        "its updates": "50.0 Hz, at most ? ms beside the mean",
        "enabled": "yes",
        "goal": "0.300, -0.200",
        "counted": "late updates: 2",
        "answer": "reset: done",
    }
    assert "answer" not in dict(robot(said="reset: done", said_at=NOW - 60).details(NOW))
    assert dict(robot().details(NOW))["joint states"] == "none yet"


@pytest.mark.parametrize("text", ["", "None", "[]", "[[1]]", "nonsense", "[1, null]", "[NaN, 1]", "{}"])
def test_a_goal_that_is_none_is_no_goal(text):
    assert robot(values={"goal": text}).goal is None
    assert robot(values={"goal": "[1, 2]"}).goal == pytest.approx(np.array([1.0, 2.0]))


def test_after_a_stop_of_all_it_is_said_who_has_not_stopped():
    one, other = robot(state="estop"), robot(namespace="/arm2")
    gone = robot(namespace="/arm3", present=False)
    assert "NOT (or no longer) stopped: arm2" in stop_words(NOW - 2, [one, other, gone], NOW)
    other.state = "estop"
    assert stop_words(NOW - 2, [one, other, gone], NOW) == (
        "stop all sent 2.0 s ago: all 2 robots say that they are stopped"
    )
