"""Joint states as robots send them, good and bad: what the node makes of each."""

import contextlib
import itertools
import math
import re
import threading
import time

import pytest
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from physai.ros.topics import qos
from physai.ros.topics.joint_states import JointStates, Publishers
from tests.ros.loop import Arm, closed_loop
from tests.waiting import wait_for

WITHIN = 0.15  # s


def spoilt(**fields):
    """Make a change of messages: fields as functions of the message."""

    def change(message):
        for name, function in fields.items():
            setattr(message, name, function(message))
        return message

    return change


def reordered(message):
    return JointState(
        header=message.header,
        name=["gripper", "joint2", "wheel", "joint1"],
        position=[0.1, message.position[1], 7.0, message.position[0]],
        velocity=[0.0, message.velocity[1], 9.0, message.velocity[0]],
        effort=[1.0, 2.0, 3.0, 4.0],
    )


def wrapped(message):
    message.position[0] = (message.position[0] + math.pi) % (2 * math.pi) - math.pi
    return message


def sometimes(change, period):
    count = itertools.count(1)
    return lambda message: change(message) if next(count) % period == 0 else message


NAN_POSITION = spoilt(position=lambda message: [message.position[0], math.nan])
REPEATED = []  # a stamp


def repeated_stamp(message):
    REPEATED.append((message.header.stamp.sec, message.header.stamp.nanosec))
    message.header.stamp.sec, message.header.stamp.nanosec = REPEATED[0]
    return message


def backwards(message):
    message.header.stamp.sec = 2_000_000_000 - message.header.stamp.sec  # int32
    message.header.stamp.nanosec = 999_999_999 - message.header.stamp.nanosec
    return message


def long_ago(message):
    message.header.stamp.sec -= 1_700_000_000
    return message


GOOD = {
    "reordered, with joints of others": reordered,
    # Rare enough for five good ones in a row, by which a hold ends that a busy machine may have caused.
    "some with NaN": sometimes(NAN_POSITION, 20),
    "some without a joint": sometimes(spoilt(name=lambda _: ["joint1", "joint3"]), 20),
    "every third lost": sometimes(lambda message: None, 3),
    "by a clock that is decades behind": long_ago,
}
BAD = {
    "position not finite": NAN_POSITION,
    "infinite position": spoilt(position=lambda message: [math.inf, message.position[1]]),
    "joint missing": spoilt(name=lambda _: ["joint1", "joint3"]),
    "one joint alone": lambda message: JointState(
        header=message.header, name=["joint1"], position=message.position[:1], velocity=message.velocity[:1]
    ),
    "duplicate name": spoilt(name=lambda _: ["joint1", "joint2", "joint1"]),
    "lengths disagree": spoilt(position=lambda message: message.position[:1]),
    "velocity missing": spoilt(velocity=lambda _: []),
    "velocity NaN": spoilt(velocity=lambda message: [message.velocity[0], math.nan]),
    "velocity implausible": spoilt(velocity=lambda _: [0.0, 50.0]),
    "stamp repeated": repeated_stamp,
    "stamp backwards": backwards,
    "nothing in it": lambda message: JointState(header=message.header),
}
COUNTED = {
    "infinite position": "states rejected: position not finite",
    "joint missing": "holds: state old",
    "one joint alone": "holds: state old",
    "velocity NaN": "states rejected: velocity missing",
    "nothing in it": "states of other joints",
}


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("change", GOOD.values(), ids=GOOD)
def test_the_arm_moves_on(loop, change):
    loop.rest()
    loop.arm.change = change
    since = loop.start_from_here()
    loop.peer.moved_on(after=since)
    assert loop.peer.states[-1][1] == "active"


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("name", BAD)
def test_the_arm_stops_counts_and_goes_on_by_itself(loop, name):
    loop.peer.set_parameters("/inference_node", resume_timeout=10.0)  # a busy machine may take its time
    loop.start()
    counted = f"count: {COUNTED.get(name, f'states rejected: {name}')}"
    before = int(loop.diagnosis(after=0.0)[2].get(counted, 0))
    REPEATED.clear()
    since = loop.arm.sent[-1]
    loop.arm.change = BAD[name]
    assert loop.peer.first_zeros(after=since) < WITHIN
    loop.peer.all_zeros(after=since + WITHIN, commands=15)
    loop.peer.wait_state("hold")
    assert int(loop.diagnosis(after=since + WITHIN / 3)[2][counted]) > before
    loop.arm.change = lambda message: message
    since = time.monotonic()
    loop.peer.moved(after=since)
    assert loop.peer.wait_state("active")


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    "change", [BAD["velocity missing"], BAD["velocity NaN"]], ids=["missing velocities", "NaN velocities"]
)
def test_are_estimated_where_that_is_allowed(loop, change):
    loop.rest()
    (answer,) = loop.peer.set_parameters("/inference_node", allow_velocity_estimate=True)
    assert answer.successful, answer.reason
    try:
        loop.arm.change = change
        since = loop.start_from_here()
        loop.peer.moved_on(after=since)
    finally:
        loop.peer.set_parameters("/inference_node", allow_velocity_estimate=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    "profile", [qos.SENSOR, QoSProfile(depth=10), qos.LATCHED], ids=["best effort", "reliable", "latched"]
)
def test_of_every_quality_of_service_are_heard(loop, profile):
    loop.arm.leave()
    loop.arm = Arm(loop.peer, profile)
    since = loop.start()
    loop.peer.moved(after=since, commands=30)


@pytest.mark.slow
def test_of_a_joint_that_counts_from_minus_pi_to_pi_lead_around_the_corner(policy_path):
    with closed_loop(policy_path, max_velocity=1.0, limit_margin=0.2) as loop:
        loop.arm.HOME = (-2.8, 0.8)
        loop.arm.change = wrapped
        loop.arm.position = [-2.8, 0.8]
        loop.peer.wait_state("waiting", "hold")
        # Within 5 cm of this goal, joint1 is past the corner with either elbow; which one is the policy's own choice.
        loop.peer.send_goal(0.4 * math.cos(2.2), 0.4 * math.sin(2.2))
        loop.peer.wait_state("reached")
        assert loop.arm.position[0] < -math.pi
        seen = [message.position[0] for _, message in loop.peer.joint_states]
        assert max(seen) > 2.0
        assert "holds: position jump" not in str(loop.diagnosis())


@pytest.mark.slow
@pytest.mark.realtime
def test_that_jump_stop_the_arm_until_they_agree(loop):
    loop.start()
    since = loop.arm.sent[-1]
    loop.arm.position = [1.0, 0.5]
    assert loop.peer.first_zeros(after=since) < 0.05
    loop.peer.moved(after=since)
    assert "position jump" in str(loop.diagnosis()[2])


@pytest.mark.slow
def test_of_an_arm_far_beyond_its_limit_are_a_fault_until_it_is_back_and_reset(loop):
    loop.start()
    loop.arm.position = [0.0, 2.85]
    loop.peer.wait_state("fault")
    level, message, _ = loop.diagnosis()
    assert level == 2
    assert "'joint2' is far beyond its position limit" in message
    since = time.monotonic()
    loop.peer.all_zeros(after=since)
    loop.peer.call("/inference_node/reset")
    loop.peer.all_zeros(after=time.monotonic(), commands=20)
    loop.peer.all_zeros(after=since)
    loop.peer.wait_state("fault")  # it is still there
    since = time.monotonic()
    loop.arm.go_home()
    loop.peer.all_zeros(after=since, commands=20)
    assert loop.peer.states[-1][1] == "fault"
    loop.start()


# In parts, beside those of others, and by two publishers.


def test_of_a_publisher_that_counts_far_ahead_are_those_of_another():
    publishers, joints = Publishers(), frozenset({"joint1", "joint2"})
    first = publishers.source(joints, 1000, 0.0)
    assert publishers.source(joints, 1060, 0.02) == first  # some were lost
    assert publishers.source(joints, 5000, 0.5) != first
    assert publishers.contested(0.5) is None


def test_are_handed_on_in_the_order_in_which_they_came(peer):
    states, number = JointStates(peer.node, ["a", "b"], lambda: None), itertools.count(1)
    for stamp, names in ((1, ["a", "b"]), (2, ["b", "a"]), (3, ["a", "b"])):
        message = JointState(name=names, position=[0.0, 0.0])
        message.header.stamp.sec = stamp
        states._keep(message, {"publication_sequence_number": next(number), "received_timestamp": 0})
    assert [state.stamp for state in states.take()] == [2, 3]


@contextlib.contextmanager
def gripper(loop, rate):
    """A broadcaster with messages of its own, of joints that are not the arm's."""
    publisher = loop.peer.node.create_publisher(JointState, "/joint_states", 10)
    message, leave = JointState(name=["finger1", "finger2"], position=[0.0, 0.0]), threading.Event()

    def run():
        due = time.monotonic()
        while not leave.wait(max(0.0, (due := due + 1 / rate) - time.monotonic())):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
            publisher.publish(message)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        leave.set()
        thread.join()
        loop.peer.remove(publisher)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("rate", [50, 200])  # at 1,000 Hz, this process would be busy with them, too
def test_of_an_arm_beside_a_gripper_move_it_as_if_it_were_alone(loop, rate):
    with gripper(loop, rate):
        since = loop.start()
        wait_for(lambda: time.monotonic() > since + 2.0)
        commands = [any(velocity) for at, velocity in list(loop.peer.commands) if since < at < since + 2.0]
        counters = loop.diagnosis()[2]
    assert sum(commands) >= 0.95 * len(commands) > 80, counters  # they name what held it
    assert int(counters["count: states of other joints"]) > 1.5 * rate


@pytest.mark.slow
@pytest.mark.realtime
def test_with_every_joint_in_a_message_of_its_own_lead_to_the_goals(policy_path):
    def apart(arm):
        def change(message):
            for place, joint in enumerate(arm.NAMES):
                part = JointState(header=message.header, name=[joint])
                part.position, part.velocity = message.position[place : place + 1], message.velocity[place : place + 1]
                arm.publish(part)

        return change

    with closed_loop(policy_path, max_velocity=1.0, limit_margin=0.2) as loop:
        loop.arm.change = apart(loop.arm)
        loop.peer.wait_state("waiting")
        for angle in (2.0, -1.5):
            since = time.monotonic()
            loop.peer.send_goal(0.4 * math.cos(angle), 0.4 * math.sin(angle))
            loop.peer.wait_state("active", after=since)
            loop.peer.wait_state("reached", after=since)
        # A stall of the computer may make one; a joint that is taken for old makes one in each period.
        assert int(loop.diagnosis()[2].get("count: holds: state old", 0)) <= 1


@pytest.mark.slow
@pytest.mark.fault("two publishers claim the same joint")
def test_of_two_publishers_that_claim_a_joint_are_a_reason_to_wait_that_names_both(loop):
    loop.start()
    impostor = Node("impostor", context=loop.peer.node.context)
    publisher = impostor.create_publisher(JointState, "/joint_states", 10)
    loop.arm.change = lambda message: publisher.publish(message) or message
    try:
        wait_for(lambda: "claim 'joint" in loop.diagnosis()[1], 10.0, lambda: loop.diagnosis()[1])
        since = time.monotonic()
        assert re.search(r"two publishers of /joint_states claim 'joint[12]': impostor, peer", loop.diagnosis()[1])
        loop.peer.all_zeros(after=since + WITHIN, commands=20)
    finally:
        loop.arm.change = lambda message: message
        time.sleep(0.05)  # until it publishes no more
        impostor.destroy_node()
    loop.peer.wait_state("waiting")
    wait_for(lambda: "no goal yet" in loop.diagnosis()[1] and "claim" not in loop.diagnosis()[1], 10.0)
    loop.peer.all_zeros(after=since + WITHIN, commands=20)


@pytest.mark.slow
@pytest.mark.parametrize("as_another", [False, True], ids=["by the same publisher", "by another"])
def test_that_come_again_after_three_seconds_move_nothing_before_a_new_goal(loop, as_another):
    loop.peer.set_parameters("/inference_node", resume_timeout=1.0)
    loop.start()
    why = "is told by another source than before" if as_another else "the robot was silent for 3"
    lines = len(loop.node.lines)
    loop.arm.pause()
    time.sleep(3.0)
    since = time.monotonic()
    if as_another:
        loop.arm.leave()
        loop.arm = Arm(loop.peer)
    loop.arm.go_home()
    loop.arm.position = [1.0, 1.0]
    loop.peer.wait_state("waiting", after=since)
    loop.peer.all_zeros(after=since, commands=30)
    wait_for(lambda: "no goal yet" in loop.diagnosis()[1])  # on a busy computer it holds for a moment
    wait_for(lambda: any("goal forgotten: " in line and why in line for line in loop.node.lines[lines:]), what=why)
    loop.start_from_here()


@pytest.mark.realtime
def test_that_come_again_after_half_a_second_move_the_arm_on(loop):
    loop.peer.set_parameters("/inference_node", resume_timeout=1.0)
    loop.start()
    loop.arm.pause()
    time.sleep(0.5)
    loop.arm.go_home()
    loop.peer.moved(after=time.monotonic())


@pytest.mark.slow
def test_by_another_publisher_than_before_need_a_new_goal_however_soon_they_come(loop):
    loop.start()
    lines = len(loop.node.lines)
    position = loop.arm.position
    since = time.monotonic()
    loop.arm.leave()
    loop.arm = Arm(loop.peer)
    loop.arm.position = position
    loop.peer.wait_state("waiting", after=since)
    loop.peer.all_zeros(after=loop.peer.states[-1][0], commands=20)
    wait_for(lambda: any("is told by another source than before" in line for line in loop.node.lines[lines:]))
    loop.start_from_here()
