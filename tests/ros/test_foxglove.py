"""The live stream: any WebSocket client finds every topic with its schema, and hears what a recording holds."""

import json
import signal
import struct
import subprocess
import sys
import time
from collections import defaultdict

import pytest
from foxglove.messages import FrameTransforms
from geometry_msgs.msg import Point, PointStamped
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from std_msgs.msg import Header
from websockets.sync.client import connect

from tests.waiting import wait_for

ROBOT = ("-r", "__ns:=/arm1")
HEARD = {
    "/arm1/joint_states": "sensor_msgs/msg/JointState",
    "/arm1/joint_velocity_controller/commands": "std_msgs/msg/Float64MultiArray",
    "/arm1/command_watchdog/commands": "std_msgs/msg/Float64MultiArray",
    "/arm1/inference_node/goal": "geometry_msgs/msg/PointStamped",
    "/arm1/inference_node/state": "std_msgs/msg/String",
    "/arm1/inference_node/estopped": "std_msgs/msg/Bool",
    "/arm1/inference_node/robot_description": "std_msgs/msg/String",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


class Watcher:
    """A client that knows the protocol alone (github.com/foxglove/ws-protocol), and nothing of physai."""

    def __init__(self, port: int) -> None:
        self._socket = connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None)
        self.channels: dict[int, dict] = {}
        self.messages: defaultdict[str, list[tuple[int, bytes]]] = defaultdict(list)

    def watch(self, seconds: float) -> None:
        """Subscribe to all that is advertised, and listen."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                frame = self._socket.recv(timeout=left)
            except TimeoutError:
                return
            if isinstance(frame, bytes):
                if frame[0] == 1:
                    channel, stamp = struct.unpack("<IQ", frame[1:13])
                    self.messages[self.channels[channel]["topic"]].append((stamp, frame[13:]))
                continue
            said = json.loads(frame)
            if said["op"] == "advertise":
                self.channels |= {channel["id"]: channel for channel in said["channels"]}
                wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in said["channels"]]
                self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def robot(start, policy_path, peer):
    """A virtual robot that is driven, in the namespace /arm1."""
    start("virtual_robot", *ROBOT, rate_hz=50.0)
    start("command_watchdog", *ROBOT, joints=2)
    node = start(
        "inference_node",
        *ROBOT,
        policy_path=policy_path,
        watchdog="command_watchdog",
        autostart=True,
        goal="[0.1, 0.4]",
    )
    node.says("reached", 60.0)


def port_of(process) -> int:
    return int(process.says("can be connected to ws://").rpartition(":")[2])


@pytest.mark.slow
def test_a_foreign_client_finds_every_channel_and_hears_what_the_recorder_writes_down(start, robot, peer, tmp_path):
    """Some seconds: a robot is driven to a goal, and then to another one."""
    layout = tmp_path / "layout.json"
    foxglove = start("foxglove", port=0, layout=layout)
    recorder = start("record", output=tmp_path / "bag", robots="all")
    recorder.says("recording")
    watcher = Watcher(port_of(foxglove))
    topic = "/arm1/inference_node/goal"
    goals = peer.publisher(PointStamped, topic)
    wait_for(lambda: watcher.watch(0.2) or goals.get_subscription_count() >= 3, 60.0, "node, recorder and stream")
    watcher.watch(2.0)
    goals.publish(goal(-0.3, 0.2))
    watcher.watch(3.0)
    watcher.close()
    recorder.signal(signal.SIGINT)
    assert recorder.wait() == 0, recorder.output

    channels = {channel["topic"]: channel for channel in watcher.channels.values()}
    assert {topic: channels[topic]["schemaName"] for topic in HEARD} == HEARD
    assert channels["/transforms"]["schemaName"] == "foxglove.FrameTransforms"
    with Reader(tmp_path / "bag") as reader:
        recorded = defaultdict(list)
        for connection, _, data in reader.messages():
            recorded[connection.topic].append(bytes(data))
    for topic, kind in HEARD.items():
        assert (channels[topic]["encoding"], channels[topic]["schemaEncoding"]) == ("cdr", "ros2msg")
        types = get_typestore(Stores.EMPTY)
        types.register(get_types_from_msg(channels[topic]["schema"], kind))  # a schema tells all that is needed
        live = [data for _, data in watcher.messages[topic]]
        assert live, topic
        assert types.deserialize_cdr(live[-1], kind).__class__.__name__.endswith(kind.rpartition("/")[2])
        both = set(live) & set(recorded[topic])
        assert len(both) > 0.8 * min(len(set(live)), len(set(recorded[topic]))), topic
    same_arm(watcher, channels)
    told = json.loads(layout.read_text())
    assert "/arm1/inference_node/robot_description" in json.dumps(told)
    assert "/arm1/joint_states" in json.dumps(told)


def goal(x: float, y: float) -> PointStamped:
    return PointStamped(header=Header(frame_id="base"), point=Point(x=x, y=y))


def same_arm(watcher: Watcher, channels: dict[str, dict]) -> None:
    """The transforms are of the robot's frames, one after the other from the world on."""
    assert channels["/transforms"]["encoding"] == "protobuf"
    assert len(watcher.messages["/transforms"]) > 30
    data = watcher.messages["/transforms"][-1][1]
    for name in (b"world", b"arm1/base", b"arm1/joint1_body", b"arm1/joint2_body", b"arm1/tip"):
        assert name in data
    assert FrameTransforms.get_schema().name == channels["/transforms"]["schemaName"]


@pytest.mark.slow
def test_who_watches_can_send_nothing(start, robot, peer):
    foxglove = start("foxglove", port=0)
    watcher = Watcher(port_of(foxglove))
    hello = json.loads(watcher._socket.recv())
    assert hello["capabilities"] == [] or "clientPublish" not in hello["capabilities"]
    advertised = {"id": 7, "topic": "/emergency_stop", "encoding": "cdr", "schemaName": "std_msgs/msg/Bool"}
    watcher._socket.send(json.dumps({"op": "advertise", "channels": [advertised]}))
    watcher._socket.send(b"\x01" + struct.pack("<I", 7) + b"\x00\x01\x00\x00\x01")
    watcher._socket.send("garbage")
    watcher.watch(0.5)
    assert peer.node.count_publishers("/emergency_stop") == 0
    assert foxglove.poll() is None


@pytest.mark.slow
def test_a_port_that_is_taken_is_one_line(start):
    first = start("foxglove", port=0)
    second = start("foxglove", port=port_of(first))
    assert second.wait() == 2
    assert "error: cannot listen on 127.0.0.1" in second.output


@pytest.mark.slow
def test_without_its_extra_one_line_names_it():
    program = "import sys; sys.modules['foxglove'] = None; from physai.ros.foxglove import main; sys.exit(main())"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ran.returncode == 2
    assert ran.stderr == "error: foxglove-sdk is not installed: pip install 'physai[foxglove]'\n"
