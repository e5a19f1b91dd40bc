"""A robot that knows nothing of ROS: another implementation of DDS (Cyclone), which closes the loop until "reached".

Usage: ``python dds_peer.py DOMAIN JOINT=POSITION...``. Its joints start there. It obeys commands at once, and prints
the states that the node announces.
"""

import os
import sys
import time
from dataclasses import dataclass

os.environ["CYCLONEDDS_URI"] = """
<CycloneDDS><Domain>
  <General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>
    <AllowMulticast>false</AllowMulticast></General>
  <Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

PERIOD = 0.01  # s


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Dimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    label: str
    size: uint32
    stride: uint32


@dataclass
class Layout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    dim: sequence[Dimension]
    data_offset: uint32


@dataclass
class Float64MultiArray(IdlStruct, typename="std_msgs::msg::dds_::Float64MultiArray_"):
    layout: Layout
    data: sequence[float64]


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


def main() -> int:
    """Return 0 when the node has said "reached" and then commands zeros."""
    participant = DomainParticipant(int(sys.argv[1]))
    xcdr1 = Policy.DataRepresentation(use_cdrv0_representation=True)
    reliable = Policy.Reliability.Reliable(duration(seconds=1))
    latest = Qos(reliable, Policy.History.KeepLast(1), xcdr1)
    latched = Qos(reliable, Policy.History.KeepLast(10), Policy.Durability.TransientLocal, xcdr1)
    states = DataWriter(participant, Topic(participant, "rt/joint_states", JointState, qos=latest), qos=latest)
    topic = Topic(participant, "rt/joint_velocity_controller/commands", Float64MultiArray, qos=latest)
    commands = DataReader(participant, topic, qos=latest)
    announced = DataReader(participant, Topic(participant, "rt/inference_node/state", String, qos=latched), qos=latched)
    places = dict(argument.split("=") for argument in sys.argv[2:])
    names, position, said = list(places), [float(place) for place in places.values()], ""
    velocity = [0.0] * len(names)
    due = time.monotonic()
    while said != "reached" or any(velocity):
        for command in commands.take():
            velocity = list(command.data)
        for state in announced.take():
            said = state.data
            print(f"the node says: {said}", flush=True)
        position = [q + v * PERIOD for q, v in zip(position, velocity, strict=True)]
        stamp = Time(*divmod(time.time_ns(), 10**9))
        states.write(JointState(Header(stamp, ""), names, position, velocity, []))
        due = max(due + PERIOD, time.monotonic() - 5 * PERIOD)
        time.sleep(max(0.0, due - time.monotonic()))
    print(f"standing at {position}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
