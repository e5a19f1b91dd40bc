"""Several robots in one domain: each in its namespace, heard and driven for itself; and one topic stops all of them."""

import os
import signal
import sys
import time
import urllib.request

import pytest
from geometry_msgs.msg import PointStamped
from rclpy.duration import Duration
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray, String

from physai.ros.topics import qos
from physai.ros.topics.commands import controller_topic
from physai.signals import Quantity
from tests.ros.peer import Peer, Process
from tests.waiting import wait_for

COMMANDS = controller_topic(Quantity.JOINT_VELOCITY)
FAR = (-0.3, -0.2)
WITHIN, LATEST = 0.05, 0.25  # s from the message to zeros at half of the robots, and at every one


class Robot:
    """What is heard of one robot of a fleet.

    Attributes:
        commands: (ns since 1970 at which it came, velocities) of every command that its controller got.
        states: (time, text) of its inference node.
    """

    def __init__(self, peer: Peer, namespace: str) -> None:
        self._peer, self.namespace = peer, namespace
        self.commands: list[tuple[int, list[float]]] = []
        self.states: list[tuple[float, str]] = []
        peer.node.create_subscription(Float64MultiArray, f"{namespace}/{COMMANDS}", self._take, 1000)
        peer.listen(String, f"{namespace}/inference_node/state", self.states, qos.LATCHED, lambda message: message.data)

    def _take(self, message: Float64MultiArray, info: dict[str, int]) -> None:
        self.commands.append((info["received_timestamp"], message.data.tolist()))

    def is_in(self, state: str) -> bool:
        return bool(self.states) and self.states[-1][1] == state

    def send_goal(self) -> None:
        message = PointStamped()
        message.header.frame_id = "base"
        message.point.x, message.point.y = FAR
        self._peer.publish(f"{self.namespace}/inference_node/goal", message)

    def moves(self) -> bool:
        return len(self.commands) > 0 and any(self.commands[-1][1])

    def zeros_after(self, since: int) -> float:
        """How much later than a time, ns, its controller got zeros, s."""
        found = wait_for(
            lambda: [at for at, velocity in self.commands if at >= since and not any(velocity)], 5.0, "zeros"
        )
        return 1e-9 * (found[0] - since)

    def reset(self) -> None:
        wait_for(lambda: self._peer.call(f"{self.namespace}/inference_node/reset").success, 10.0, "a reset")
        wait_for(lambda: self.is_in("waiting"), 10.0, "a robot that waits")


def fleet_of(start, peer, policy_path, count: int) -> list[Robot]:
    """Start robots with their watchdogs and inference nodes; all of them are on their way when this returns."""
    robots = [Robot(peer, f"/arm{number}") for number in range(1, count + 1)]
    for robot in robots:
        own = ("-r", f"__ns:={robot.namespace}")
        start("virtual_robot", *own, rate_hz=50.0)
        start("command_watchdog", *own, joints=2)
        start("inference_node", *own, policy_path=policy_path, watchdog="command_watchdog", autostart=True)
    for robot in robots:
        wait_for(lambda robot=robot: robot.is_in("waiting"), 60.0, f"{robot.namespace}, which waits for a goal")
    set_off(robots)
    return robots


def set_off(robots: list[Robot]) -> None:
    for robot in robots:
        robot.send_goal()
    wait_for(lambda: all(robot.moves() for robot in robots), 20.0, "robots on their way")


@pytest.mark.slow
@pytest.mark.fault("true on `/emergency_stop`, or on `<namespace>/emergency_stop`")
def test_each_robot_is_driven_and_stopped_for_itself_and_one_topic_stops_all(start, peer, policy_path):
    """Some seconds: six processes, and the ways in which two robots could disturb each other."""
    button = peer.publisher(Bool, "/emergency_stop", qos.LATCHED)  # early enough to be known when it is pressed
    left, right = robots = fleet_of(start, peer, policy_path, 2)
    peer.publish("/arm1/emergency_stop", Bool(data=True))
    wait_for(lambda: left.is_in("estop"))
    wait_for(lambda: not any(any(velocity) for _, velocity in left.commands[-5:]), 5.0, "an arm that stands")
    assert not right.is_in("estop")
    left.reset()
    set_off(robots)
    button.publish(Bool(data=True))
    for robot in robots:
        wait_for(lambda robot=robot: robot.is_in("estop"), what=f"a stop of {robot.namespace}")
    answer = peer.call("/arm2/inference_node/reset")
    assert (answer.success, answer.message) == (False, "/emergency_stop is still true, latched: peer")
    button.publish(Bool(data=False))
    for robot in robots:
        robot.reset()


@pytest.mark.slow
@pytest.mark.realtime
def test_one_message_stops_every_robot_at_once(start, peer, policy_path):
    """Many seconds, of which most are waiting: `python -m physai.bench --fleet` measures it with eight robots."""
    robots = fleet_of(start, peer, policy_path, 2)
    everyone = peer.publisher(Bool, "/emergency_stop", 1)  # of depth 1, it is acknowledged at once
    wait_for(lambda: everyone.get_subscription_count() >= 2 * len(robots))
    late = []
    for trial in range(3):
        if trial:
            for robot in robots:
                robot.reset()
            set_off(robots)
        time.sleep(0.2)
        since = time.time_ns()
        everyone.publish(Bool(data=True))
        late += [robot.zeros_after(since) for robot in robots]
        everyone.publish(Bool(data=False))
        assert everyone.wait_for_all_acked(Duration(seconds=5))
    late.sort()
    assert late[len(late) // 2] < WITHIN, late
    assert late[-1] < LATEST, late  # where six processes share two cores


@pytest.mark.slow
def test_the_recorder_takes_all_robots_those_that_come_later_too(start, peer, tmp_path):
    recorder = start("record", output=tmp_path / "bag", robots="all")
    recorder.says("of all robots")
    for namespace in ("", "/arm1", "/left/arm2"):
        topic = f"{namespace}/inference_node/state"
        publisher = peer.publisher(String, topic, qos.LATCHED)
        publisher.publish(String(data=namespace))
        recorder.says(f"{topic}: the first message")
    recorder.signal(signal.SIGINT)
    assert recorder.wait() == 0, recorder.output
    with Reader(tmp_path / "bag") as reader:
        assert {connection.topic for connection in reader.connections} >= {
            "/inference_node/state",
            "/arm1/inference_node/state",
            "/left/arm2/inference_node/state",
        }


TOGETHER = """
import sys
from functools import partial
from physai.ros.node.run import run_together
from physai.ros.virtual_robot import VirtualRobot

class Robot(VirtualRobot):
    steps = 0

    def _step(self):
        super()._step()
        self.steps += 1
        if self.get_namespace() == "/right" and self.steps == int(sys.argv[2]):
            raise ValueError("it broke")

    def finish(self):
        super().finish()
        print(self.get_namespace(), "has finished", flush=True)

def robot(namespace, rate):
    return partial(Robot, ["--ros-args", "-r", f"__ns:={namespace}", "-p", f"rate_hz:={rate}"])

sys.exit(run_together({"/left": robot("/left", 25), "/right": robot("/right", sys.argv[1])}))
"""


def together(start, rate: float, steps: int) -> Process:
    """Start two robots in one process: the right one sends at that rate, and raises after so many steps."""
    return start.run([sys.executable, "-c", TOGETHER, str(rate), str(steps)])


@pytest.mark.slow
def test_nodes_that_share_a_process_have_their_own_namespaces_and_parameters_and_end_together(start, peer):
    process = together(start, 100.0, 0)
    came = {"/left": [], "/right": []}
    for namespace, times in came.items():
        peer.listen(JointState, f"{namespace}/joint_states", times, 10, lambda message: message.name)
    wait_for(lambda: len(came["/left"]) > 25, 60.0, "joint states")
    assert 3.0 < len(came["/right"]) / len(came["/left"]) < 5.0
    process.signal(signal.SIGTERM)
    assert process.wait(30) == 0, process.output
    assert {"/left has finished", "/right has finished"} < set(process.lines)


@pytest.mark.slow
def test_when_one_of_the_nodes_that_share_a_process_breaks_all_of_them_finish(start):
    process = together(start, 100.0, 20)
    assert process.wait(60) == 1
    assert {"/left has finished", "/right has finished"} < set(process.lines)
    assert "ValueError ends this process: it broke" in process.output


@pytest.mark.slow
def test_nodes_that_share_a_process_do_not_start_if_one_of_them_cannot(start):
    process = together(start, 0.0, 0)
    assert process.wait(60) == 2
    assert process.lines[-1].startswith("error: /right: rate_hz: must lie between")


@pytest.mark.slow
@pytest.mark.realtime
def test_the_demo_drives_a_fleet_and_leaves_nothing_behind(start, policy_path):
    process = start.command("ros.fleet", f"policies=[{policy_path}]", "arms=2", "seconds=12", "randomization=none")
    assert process.wait(120) == 0, process.output
    told = [line for line in process.lines if "goals reached" in line]
    assert len(told) == 2
    assert all(int(line.split()[1]) >= 1 for line in told), process.output


@pytest.mark.slow
def test_ctrl_c_ends_the_demo_and_all_of_its_nodes_and_its_page(start, policy_path):
    process = start.command("ros.fleet", f"policies=[{policy_path}]", "arms=2", "render=web", "web.port=0")
    process.says("all of them work", 60.0)
    address = process.says("the page: http://127.0.0.1:", 60.0).split()[-1]
    with urllib.request.urlopen(address, timeout=30.0) as page:
        assert b"viser" in page.read().lower()
    nodes = children(process)
    assert len(nodes) == 4  # robots, watchdogs, who drives, the page
    process.signal(signal.SIGINT)
    assert process.wait(30) == 0, process.output
    assert not any(map(runs, nodes))


@pytest.mark.slow
def test_a_namespace_that_has_a_robot_already_is_left_alone(start, policy_path):
    start("virtual_robot", "-r", "__ns:=/arm1").says("takes joint_velocity", 60.0)
    process = start.run([sys.executable, "-m", "physai.ros.fleet", f"policies=[{policy_path}]", "arms=1"])
    assert process.wait(120) == 2
    assert "error: another robot tells of itself on /arm1/joint_states" in process.output


def children(process: Process) -> list[int]:
    with open(f"/proc/{process.pid}/task/{process.pid}/children") as file:
        return [int(child) for child in file.read().split()]


def runs(pid: int) -> bool:
    return os.path.exists(f"/proc/{pid}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["arms=65"], "arms: 64 at most, got 65"),
        (["policies=[nowhere.pt]"], "nowhere.pt: no such file"),
        (["render=video"], "render: input should be 'web'"),
        (["arm=3"], "unknown key 'arm'; did you mean 'arms'?"),
    ],
)
def test_what_cannot_be_is_one_line(start, policy_path, overrides, said):
    process = start.command("ros.fleet", f"policies=[{policy_path}]", *overrides)
    assert process.wait(60) == 2
    assert f"error: {said}" in process.output
