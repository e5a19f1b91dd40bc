"""The recorder: what it heard is in the bag once, however the publishers publish and however it ends."""

import resource
import signal
import sys
import time
from pathlib import Path

import pytest
from geometry_msgs.msg import PointStamped
from nav_msgs.msg import Goals
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray, String, UInt64
from stereo_msgs.msg import DisparityImage

from physai.errors import UserError
from physai.ros.recording.bag import TYPES, Bag, recover
from tests.waiting import wait_for

KINDS = {
    "best_effort": QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT),
    "reliable": QoSProfile(depth=100),
    "latched": QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    "latched_best_effort": QoSProfile(
        depth=100, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.TRANSIENT_LOCAL
    ),
}
RATE = 500.0  # Hz


def read(folder: Path, topic: str, kind: type) -> list:
    """(ns, message) of a topic, as a reader without physai finds them."""
    with Reader(folder) as reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        return [(stamp, deserialize_message(data, kind)) for _, stamp, data in reader.messages(connections)]


def numbers(folder: Path, topic: str = "/numbers") -> list[int]:
    return [message.data for _, message in read(folder, topic, UInt64)] if list(folder.glob("*")) else []


def send_numbers(peer, count: int, profile: QoSProfile, first: int = 0, topic: str = "/numbers") -> Publisher:
    publisher = peer.publisher(UInt64, topic, profile)
    wait_for(publisher.get_subscription_count, what="the recorder")
    if profile.reliability is ReliabilityPolicy.BEST_EFFORT:
        time.sleep(0.3)  # the recorder must have found the publisher, too, and nothing tells
    begin = time.monotonic()
    for index in range(count):
        publisher.publish(UInt64(data=first + index))
        time.sleep(max(0.0, begin + (index + 1) / RATE - time.monotonic()))
    return publisher


def have_arrived(*publishers: Publisher) -> None:
    """Wait for what they sent to arrive; a heartbeat that asks for it comes every three seconds."""
    for publisher in publishers:
        if publisher.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT:
            time.sleep(0.1)  # no acknowledgement tells
        else:
            assert publisher.wait_for_all_acked(Duration(seconds=5))


def start_recorder(start, folder: Path, *topics: str):
    chosen = {"topics": f"[{', '.join(topics)}]"} if topics else {}
    recorder = start("record", output=folder, **chosen)
    recorder.says("recording")
    return recorder


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("kind", "end"),
    [
        ("best_effort", signal.SIGINT),
        ("reliable", signal.SIGINT),
        ("reliable", signal.SIGTERM),
        ("latched", signal.SIGHUP),
    ],
)
def test_every_message_is_there_once(start, peer, tmp_path, kind, end):
    recorder = start_recorder(start, tmp_path / "bag", "/numbers")
    have_arrived(send_numbers(peer, 1000, KINDS[kind]))
    recorder.signal(end)
    assert recorder.wait() == 0
    assert numbers(tmp_path / "bag") == list(range(1000))
    assert "/numbers: the first message (std_msgs/msg/UInt64)" in recorder.output
    assert recorder.says("1,000 messages, 0.0 MB")
    assert recorder.says(f"recorded to {tmp_path / 'bag'}")


@pytest.mark.slow
@pytest.mark.realtime
def test_publishers_of_all_kinds_share_a_topic(start, peer, tmp_path):
    early = peer.publisher(UInt64, "/numbers", KINDS["latched"])
    for number in range(10):
        early.publish(UInt64(data=number))  # before there is a recorder
    recorder = start_recorder(start, tmp_path / "bag", "/numbers")
    recorder.says("the first message")
    publishers = []
    for first, kind in [(100, "reliable"), (150, "best_effort"), (200, "latched"), (250, "latched_best_effort")]:
        publishers.append(send_numbers(peer, 25, KINDS[kind], first))
        publishers.append(send_numbers(peer, 25, KINDS["reliable"], first + 25))
    have_arrived(*publishers)
    recorder.signal(signal.SIGINT)
    assert recorder.wait() == 0
    assert sorted(numbers(tmp_path / "bag")) == [*range(10), *range(100, 300)]


def same_end(some: list, others: list) -> bool:
    """Whether both are the same but for the beginning, which each may have missed before it was found."""
    length = min(len(some), len(others))
    return length > 0 and some[-length:] == others[-length:]


@pytest.mark.slow
@pytest.mark.realtime
def test_a_session_is_recorded_as_it_was(start, peer, policy_path, tmp_path):
    estopped, joint_states = [], []
    peer.listen(Bool, "/inference_node/estopped", estopped, KINDS["latched"], lambda message: message.data)
    peer.listen(JointState, "/joint_states", joint_states, 10_000)  # deep: this process is sometimes slow
    recorder = start_recorder(start, tmp_path / "bag")
    start("virtual_robot")
    node = start("inference_node", policy_path=policy_path, autostart=True, max_velocity=1.0, limit_margin=0.2)
    node.says("drives")
    everybody = peer.publisher(PointStamped, "/inference_node/goal")
    wait_for(lambda: everybody.get_subscription_count() == 2, what="the node and the recorder")
    for topic in ("/inference_node/state", "/inference_node/estopped", "/joint_velocity_controller/commands"):
        recorder.says(f"{topic}: the first message")
    goals = [(0.1, 0.4), (-0.3, -0.2)]
    for x, y in goals:
        peer.wait_state("waiting", "reached")
        peer.send_goal(x, y)
        since, _ = peer.wait_state("active")
        peer.wait_state("reached", after=since)
    peer.emergency_stop()
    peer.wait_state("estop")
    time.sleep(0.3)
    recorder.signal(signal.SIGINT)
    assert recorder.wait() == 0

    bag = tmp_path / "bag"
    assert [(m.point.x, m.point.y) for _, m in read(bag, "/inference_node/goal", PointStamped)] == goals
    states = [m.data for _, m in read(bag, "/inference_node/state", String)]
    assert states.count("active") >= len(goals)  # more, where a busy machine made it hold in between
    assert same_end(states, [state for _, state in peer.states])
    assert [m.data for _, m in read(bag, "/emergency_stop", Bool)] == [True]
    pressed = [m.data for _, m in read(bag, "/inference_node/estopped", Bool)]
    assert pressed[-1]
    assert same_end(pressed, [message for _, message in estopped])
    recorded = [(m.header.stamp.sec, m.header.stamp.nanosec) for _, m in read(bag, "/joint_states", JointState)]
    heard = [(m.header.stamp.sec, m.header.stamp.nanosec) for _, m in list(joint_states)]
    begin, end = max(recorded[0], heard[0]), min(recorded[-1], heard[-1])  # each found the robot at its own time
    common = [stamp for stamp in recorded if begin <= stamp <= end]
    assert len(common) > 200
    assert common == [stamp for stamp in heard if begin <= stamp <= end]
    commands = [m.data.tolist() for _, m in read(bag, "/joint_velocity_controller/commands", Float64MultiArray)]
    heard = [command for _, command in peer.commands]
    assert len(commands) > 100
    assert heard[-1] == commands[-1] == [0.0, 0.0]
    moving = [command for command in heard if any(command)]
    assert [command for command in commands if any(command)][-len(moving) :] == moving
    with Reader(bag) as reader:
        offered = {connection.topic: connection.ext.offered_qos_profiles for connection in reader.connections}
        assert "/diagnostics" in offered
        assert [profile.durability.name for profile in offered["/inference_node/state"]] == ["TRANSIENT_LOCAL"]
        assert [profile.durability.name for profile in offered["/joint_states"]] == ["VOLATILE"]
        stamps = [stamp for _, stamp, _ in reader.messages()]
        assert stamps == sorted(stamps)
        assert abs(stamps[-1] - time.time_ns()) < 60e9
        for connection, _, data in reader.messages():  # CDR; DDS makes its length a multiple of 4
            message = TYPES.deserialize_cdr(data, connection.msgtype)
            assert 0 <= len(data) - len(TYPES.serialize_cdr(message, connection.msgtype)) < 4


@pytest.mark.slow
@pytest.mark.realtime
def test_a_killed_recording_is_completed(start, peer, tmp_path):
    bag = tmp_path / "bag"
    recorder = start_recorder(start, bag, "/numbers", "/joint_states")
    busy = start("record", recover=bag)
    assert busy.wait() == 2
    assert busy.output == f"error: {bag} is still being recorded"
    have_arrived(send_numbers(peer, 700, KINDS["reliable"]))
    recorder.signal(signal.SIGKILL)
    recorder.wait()
    assert [path.name for path in bag.iterdir()] == ["bag.mcap"]

    recovery = start("record", recover=bag)
    assert recovery.wait() == 0
    found = numbers(bag)
    assert found == list(range(len(found)))
    assert len(found) >= 700 - 0.3 * RATE
    assert f"{bag} is complete: {len(found):,} messages" in recovery.output
    assert sorted(path.name for path in bag.iterdir()) == ["bag.mcap", "metadata.yaml"]

    again = start("record", recover=bag)
    assert again.wait() == 2
    assert again.output == f"error: {bag} is complete"


@pytest.mark.slow
def test_a_full_disk_ends_a_recording_in_one_line(start, peer, tmp_path):
    bag = tmp_path / "bag"

    recorder = start_recorder(start, bag, "/text")
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))  # a full disk's cousin
    peer.publish("/text", message := String(data="x" * 10_000))
    while recorder.poll() is None:  # it may go at any moment, and nobody listens then
        peer.publisher(String, "/text").publish(message)
        time.sleep(0.01)
    assert recorder.wait() == 1
    [line] = [line for line in recorder.lines if "FATAL" in line]
    assert line.endswith(f"{bag}: File too large; -p recover:={bag} completes what is there")
    assert "Traceback" not in recorder.output
    assert 10 < recover(bag) <= 100
    assert all(message.data == "x" * 10_000 for _, message in read(bag, "/text", String))


@pytest.mark.slow
def test_what_cannot_be_recorded_is_named_and_left_out(start, peer, tmp_path):
    hidden = "import sys; sys.modules['stereo_msgs.msg'] = None; from physai.ros.record import main; sys.exit(main())"
    parameters = ["-p", f"output:={tmp_path / 'bag'}", "-p", "topics:=[/disparity, /goals, /numbers]"]
    recorder = start.run([sys.executable, "-c", hidden, "--ros-args", *parameters])
    recorder.says("recording")
    peer.publisher(DisparityImage, "/disparity")
    peer.publisher(Goals, "/goals")
    have_arrived(send_numbers(peer, 10, KINDS["reliable"]))
    recorder.says("/disparity is not heard: 'stereo_msgs/msg/DisparityImage' is not installed here")
    recorder.says("/goals is not heard: 'nav_msgs/msg/Goals' is no message of ROS 2 Jazzy")
    recorder.signal(signal.SIGINT)
    assert recorder.wait() == 0
    assert numbers(tmp_path / "bag") == list(range(10))
    assert recorder.output.count("is not heard") == 2


@pytest.mark.slow
def test_it_ends_by_itself(start, tmp_path):
    recorder = start("record", output=tmp_path / "bag", duration=0.5, topics="[relative/name]")
    assert recorder.wait() == 0
    assert "recording /relative/name to" in recorder.output
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"output": "."}, "error: . exists already"),
        ({"output": "/dev/null/bag"}, "error: /dev/null/bag: Not a directory"),
        ({"output": "/proc/bag"}, "error: /proc/bag: No such file or directory"),
        ({"topics": "['/a b']"}, "error: topics: failed to resolve name: topic name must not contain"),
        ({"topics": "['']"}, "error: topics: failed to resolve name: topic name must not be empty string"),
        ({"topics": "3"}, "error: topics: a tuple is needed, got 3"),
        ({"duration": "-1"}, "error: duration: must lie between 0 and 1e+09 s, got -1.0"),
        ({"recover": "/nowhere"}, "error: /nowhere holds no recording"),
    ],
)
def test_bad_input_is_one_line(start, parameters, line):
    recorder = start("record", **parameters)
    assert recorder.wait() == 2
    assert recorder.output.startswith(line)
    assert len(recorder.lines) == 1


@pytest.mark.slow
def test_every_cut_of_a_recording_is_completed(tmp_path):
    """As a power cut leaves it: the file ends anywhere."""
    bag = Bag(tmp_path / "bag")
    bag.add("/numbers", "std_msgs/msg/UInt64")
    ends = []  # of the file after each flush
    for number in range(5):
        bag.write("/numbers", "std_msgs/msg/UInt64", 5 - number, serialize_message(UInt64(data=number)))
        bag.flush()
        ends.append((tmp_path / "bag" / "bag.mcap").stat().st_size)
    bag.close()
    whole = (tmp_path / "bag" / "bag.mcap").read_bytes()
    for size in range(60, len(whole), 7):
        cut = tmp_path / f"cut_{size}"
        cut.mkdir()
        (cut / "bag.mcap").write_bytes(whole[:size])
        count = recover(cut)
        assert count >= sum(end <= size for end in ends)
        assert numbers(cut) == list(reversed(range(count)))


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "bag.mcap").write_bytes(b"something else")
    with pytest.raises(UserError, match=r"File magic is invalid"):
        recover(tmp_path)
