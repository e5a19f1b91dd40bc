"""The virtual robot: the real controller's manners, and each of its faults."""

import math
import signal
import time
from array import array

import pytest
from std_msgs.msg import Float64MultiArray

from tests.ros.forge import forged
from tests.ros.loop import FAR
from tests.ros.peer import TOPIC, Peer, free_domain
from tests.waiting import wait_for

NODE = "/virtual_robot"


class Robot:
    """A virtual robot's process and a peer that commands it."""

    def __init__(self, domain: int, **parameters) -> None:
        self.peer = Peer(domain)
        self.process = forged("virtual_robot", domain, **parameters)
        commands = self.peer.publisher(Float64MultiArray, TOPIC, 1)
        # The peer listens, too.
        wait_for(lambda: commands.get_subscription_count() == 2 and self.peer.joint_states, what="the robot")

    def command(self, *velocity: float) -> float:
        self.peer.publish(TOPIC, Float64MultiArray(data=array("d", velocity)), 1)
        return time.monotonic()

    def state(self, after: float | None = None):
        """Wait for a joint state."""
        after = time.monotonic() if after is None else after
        return wait_for(lambda: next((m for at, m in reversed(self.peer.joint_states) if at > after), None))

    def settles_at(self, *velocity: float) -> None:
        wait_for(
            lambda: all(abs(v - w) < 0.01 for v, w in zip(self.state().velocity, velocity, strict=True)),
            5.0,
            f"velocities {velocity}",
        )

    def set(self, **values) -> None:
        for answer in self.peer.set_parameters(NODE, **values):
            assert answer.successful, answer.reason

    def close(self) -> None:
        self.process.end()
        self.peer.close()


def seconds(message) -> float:
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


@pytest.fixture(scope="module")
def shared():
    with free_domain() as domain:
        made = Robot(domain)
        yield made
        made.close()


@pytest.fixture
def robot(shared):
    """The robot of this module, at home and without faults."""
    shared.set(fault_stop=False, fault_delay=0.0, fault_nan=0.0, fault_drop=0.0, fault_noise=0.0)
    shared.set(fault_reorder=False, fault_empty_velocity=False, command_timeout=0.0)
    assert shared.peer.call(f"{NODE}/reset").success
    shared.settles_at(0.0, 0.0)
    return shared


@pytest.fixture
def other(domain):
    """Make a robot with parameters of its own."""
    made = []

    def other(**parameters):
        made.append(Robot(domain, **parameters))
        return made[-1]

    yield other
    for robot in made:
        robot.close()


def test_its_arm_goes_on_while_its_computer_has_no_time_for_it(robot):
    robot.command(0.5, 0.0)
    robot.settles_at(0.5, 0.0)
    robot.process.signal(signal.SIGSTOP)
    time.sleep(0.4)
    before = robot.state(after=0.0)
    robot.process.signal(signal.SIGCONT)
    after = robot.state()
    passed = seconds(after) - seconds(before)
    assert passed > 0.3
    assert (after.position[0] - before.position[0]) / passed == pytest.approx(0.5, rel=0.1)


def test_it_holds_the_last_velocity_and_drops_what_is_not_finite(robot):
    robot.command(0.2, -0.1)
    robot.settles_at(0.2, -0.1)
    robot.command(math.nan, 0.0)
    robot.command(0.0, math.inf)
    robot.state(after=time.monotonic() + 0.3)
    robot.settles_at(0.2, -0.1)


def test_a_command_of_a_wrong_length_makes_it_deaf_until_a_reset(robot):
    robot.command(0.2, -0.1)
    robot.settles_at(0.2, -0.1)
    robot.command(0.2)
    robot.process.says("1 numbers for 2 joints: inactive until ~/reset")
    robot.settles_at(0.0, 0.0)
    robot.command(0.3, 0.3)
    robot.state(after=time.monotonic() + 0.2)
    robot.settles_at(0.0, 0.0)
    robot.peer.call(f"{NODE}/reset")
    robot.command(0.3, 0.3)
    robot.settles_at(0.3, 0.3)


@pytest.mark.slow
def test_a_bad_command_counts_although_a_good_one_follows_before_the_next_step(robot):
    for velocity in ([0.1], [0.1, 0.2]):
        robot.peer.publish(TOPIC, Float64MultiArray(data=array("d", velocity)), 10)
    wait_for(lambda: "inactive until ~/reset" in robot.process.output, what="a robot that is deaf")
    robot.settles_at(0.0, 0.0)
    assert robot.peer.call(f"{NODE}/reset").success


@pytest.mark.slow
@pytest.mark.realtime
def test_states_come_a_hundred_times_a_second_in_order(robot):
    since = time.monotonic()
    wait_for(lambda: robot.peer.joint_states[-1][0] > since + 2.0)
    states = [(at, m) for at, m in robot.peer.joint_states if at > since]
    assert 140 <= len(states) <= 210  # a stalled computer loses some
    stamps = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for _, m in states]
    assert stamps == sorted(set(stamps))
    assert abs(stamps[-1] - time.time()) < 5.0


def test_a_command_timeout_can_be_set_while_it_moves(robot):
    robot.command(0.2, 0.0)
    robot.settles_at(0.2, 0.0)
    robot.set(command_timeout=0.05)
    robot.settles_at(0.0, 0.0)


@pytest.mark.slow
@pytest.mark.realtime
def test_each_fault_can_be_switched_on_and_off_while_it_runs(robot):
    def seen(count: int = 60):
        robot.state()
        begin = len(robot.peer.joint_states)
        wait_for(lambda: len(robot.peer.joint_states) >= begin + count)
        return [message for _, message in robot.peer.joint_states[begin : begin + count]]

    assert all(list(m.name) == ["joint1", "joint2"] for m in seen())
    robot.set(fault_reorder=True)
    found = seen()
    assert {tuple(m.name) for m in found} == {("joint1", "joint2"), ("joint2", "joint1")}
    assert all(abs(dict(zip(m.name, m.position, strict=True))["joint2"] - 0.5) < 0.6 for m in found)
    robot.set(fault_reorder=False, fault_nan=0.5)
    assert 5 < sum(any(map(math.isnan, m.position)) for m in seen()) < 55
    robot.set(fault_nan=0.0, fault_empty_velocity=True)
    assert all(len(m.velocity) == 0 for m in seen())
    robot.set(fault_empty_velocity=False, fault_noise=0.5)
    assert len({round(m.position[0], 6) for m in seen()}) > 50
    robot.set(fault_noise=0.0, fault_delay=0.5)
    message = robot.state(after=time.monotonic() + 1.0)
    assert 0.45 < time.time() - message.header.stamp.sec - message.header.stamp.nanosec * 1e-9 < 1.0
    robot.set(fault_delay=0.0, fault_drop=0.8)
    since = time.monotonic() + 0.3  # those that were held back come at once
    wait_for(lambda: time.monotonic() > since + 2.0)
    assert 10 < len([at for at, _ in robot.peer.joint_states if since < at < since + 2.0]) < 90
    robot.set(fault_drop=0.0, fault_stop=True)
    since = time.monotonic()
    wait_for(lambda: time.monotonic() > since + 0.3)
    assert not [at for at, _ in robot.peer.joint_states if at > since + 0.1]
    robot.set(fault_stop=False)
    robot.state()


@pytest.mark.slow
def test_joints_are_commanded_and_shown_in_the_order_that_is_asked_for(other):
    robot = other(joints="[joint2, joint1]", state_joints="[gripper, joint1, lid, joint2]")
    robot.command(-0.2, 0.1)  # of joint2 and joint1
    robot.settles_at(0.0, 0.1, 0.0, -0.2)
    message = robot.state()
    assert list(message.name) == ["gripper", "joint1", "lid", "joint2"]
    assert (message.position[0], message.position[2]) == (0.0, 0.0)


@pytest.mark.realtime
@pytest.mark.slow
def test_the_inference_node_lives_with_faults_that_leave_enough_and_stops_for_the_others(start, peer, policy_path):
    # No other joint in the states: a NaN there would spoil nothing, and five good states in a row end a hold.
    start("virtual_robot", joints="[joint2, joint1]", state_joints="[joint2, joint1]", randomization="strong")
    start("inference_node", policy_path=policy_path, autostart=True, joints="[joint2, joint1]", goal=list(FAR))
    peer.moved()
    for fault, value in [("reorder", True), ("nan", 0.3), ("drop", 0.3), ("noise", 0.002)]:
        peer.set_parameters(NODE, **{f"fault_{fault}": value})
        since = time.monotonic()
        peer.moved(after=since, commands=20)
        peer.set_parameters(NODE, **{f"fault_{fault}": type(value)()})
    for fault, value in [("stop", True), ("nan", 1.0), ("drop", 1.0), ("noise", 1.0), ("empty_velocity", True)]:
        peer.wait_state("active")
        since = time.monotonic()
        peer.set_parameters(NODE, **{f"fault_{fault}": value})
        peer.wait_state("hold", after=since)
        peer.all_zeros(after=time.monotonic() + 0.05)
        since = time.monotonic()
        peer.set_parameters(NODE, **{f"fault_{fault}": type(value)()})
        peer.moved(after=since)
