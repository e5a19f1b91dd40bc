"""One robot behind topics, as a physics engine: the virtual robot in its own process."""

import gc
import signal
import sys
import time

import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import Float64MultiArray

from physai.errors import UserError
from physai.physics import RobotState, nominal_dynamics
from physai.robots import RobotSpec
from physai.ros import RosPhysics
from physai.ros.bridge.robot_link import RobotError
from tests.ros.peer import TOPIC
from tests.waiting import wait_for

DT = 0.02
OPTIONS = {"homing_speed": 2.0, "state_timeout": 0.5, "reset_service": "/virtual_robot/reset", "remap": []}
ROW = np.zeros(1, dtype=int)
REST = np.zeros((1, 2))


@pytest.fixture
def spec(reacher):
    return RobotSpec.from_config(reacher.robot)


@pytest.fixture
def connect(spec, domain, monkeypatch):
    """Make a RosPhysics in the test's domain; it is closed after the test."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    made = []

    def connect(robots=1, **options):
        made.append(RosPhysics(spec, robots, DT, 1, **{**OPTIONS, **options}))
        return made[-1]

    yield connect
    for physics in made:
        physics.close()


def home(physics):
    physics.reset(ROW, RobotState(REST, REST))


def arrays(state):
    return state.joint_position, state.joint_velocity


def move(physics, velocity, steps):
    for _ in range(steps):
        state = physics.step(np.array([velocity]))
    return arrays(state)


def set_fault(peer, **values):
    request = SetParameters.Request(parameters=[Parameter(k, value=v).to_parameter_msg() for k, v in values.items()])
    answer = peer.call_service(SetParameters, "/virtual_robot/set_parameters", request)
    assert all(result.successful for result in answer.results)


def zeros_last(peer):
    return peer.commands and not any(peer.commands[-1][1])


@pytest.mark.slow
@pytest.mark.realtime
def test_steps_take_a_control_period_and_do_not_drift(start_robot, connect):
    start_robot()
    physics = connect()
    home(physics)
    times = [time.monotonic()]
    for _ in range(150):
        move(physics, [0.1, 0.1], 1)
        times.append(time.monotonic())
    periods = np.diff(times) * 1e3
    print(f"periods: median {np.median(periods):.2f}, p99 {np.percentile(periods, 99):.2f}, max {periods.max():.2f} ms")
    assert np.median(periods) == pytest.approx(20.0, abs=0.5)
    assert periods.mean() == pytest.approx(20.0, abs=1.0)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_caller_who_is_late_gets_whole_periods_again(start_robot, connect):
    start_robot()
    physics = connect()
    home(physics)
    move(physics, [0.1, 0.1], 2)
    time.sleep(0.07)  # on purpose: three periods and a half
    before = time.monotonic()
    for periods in (1, 2, 3):  # however long a stalled computer makes one of them: the next may make up for that
        move(physics, [0.1, 0.1], 1)
        assert time.monotonic() - before >= periods * DT


@pytest.mark.slow
@pytest.mark.realtime
def test_joints_are_mapped_by_name_and_others_ignored(start_robot, connect):
    start_robot("-p", "state_joints:=[gripper, joint2, joint1]")
    physics = connect()
    home(physics)
    q, qd = move(physics, [0.5, -0.25], 50)
    assert q.shape == qd.shape == (1, 2)
    np.testing.assert_allclose(q[0], [0.5, -0.25], atol=0.05)
    np.testing.assert_allclose(qd[0], [0.5, -0.25], atol=0.02)


@pytest.mark.slow
@pytest.mark.realtime
def test_the_reset_service_puts_a_virtual_robot_home_at_once(start_robot, connect):
    start_robot()
    physics = connect()
    move(physics, [2.0, -2.0], 50)
    before = time.monotonic()
    home(physics)
    assert time.monotonic() - before < 1.0  # driving 2 rad at 2 rad/s would take longer
    np.testing.assert_allclose(physics.robot_state().joint_position, 0.0, atol=0.02)


@pytest.mark.slow
def test_a_robot_without_the_service_is_driven_home_and_stands_there(start_robot, connect, peer):
    start_robot("-r", "__node:=arm")
    physics = connect(homing_speed=1.0)
    move(physics, [2.0, -1.0], 40)
    since = time.monotonic()
    home(physics)
    q, qd = arrays(physics.robot_state())
    assert np.abs(q).max() <= 0.02
    np.testing.assert_allclose(qd, 0.0, atol=0.01)
    wait_for(lambda: zeros_last(peer))
    sent = np.array([command for at, command in peer.commands if at > since + 0.1])
    assert 0.9 < np.abs(sent).max() <= 1.0 + 1e-9
    assert not sent[-1].any()


@pytest.mark.slow
def test_a_continuous_joint_goes_the_shorter_way_around(start_robot, connect):
    start_robot("-r", "__node:=arm")
    physics = connect()
    physics.reset(ROW, RobotState(np.array([[3.0, 0.0]]), REST))
    physics.reset(ROW, RobotState(np.array([[-3.0, 0.0]]), REST))
    assert physics.robot_state().joint_position[0, 0] == pytest.approx(2 * np.pi - 3.0, abs=0.021)


@pytest.mark.slow
def test_an_arm_that_does_not_get_to_its_start_is_named(start_robot, connect, peer):
    start_robot("-r", "__node:=arm", "-r", f"{TOPIC}:=/elsewhere")
    physics = connect()
    with pytest.raises(RobotError, match=r"does not get to its start: 0.500 rad off after \d s"):
        physics.reset(ROW, RobotState(np.array([[0.5, 0.0]]), REST))
    wait_for(lambda: zeros_last(peer))


@pytest.mark.slow
@pytest.mark.realtime
def test_a_robot_that_falls_silent_is_stopped_and_can_be_used_again(start_robot, connect, peer):
    robot = start_robot()
    physics = connect()
    home(physics)
    move(physics, [0.5, 0.5], 5)
    robot.signal(signal.SIGSTOP)
    before = time.monotonic()
    with pytest.raises(RobotError, match=r"no joint state came on /joint_states within 0.5 s"):
        move(physics, [0.5, 0.5], 10)
    assert time.monotonic() - before < 1.5
    wait_for(lambda: zeros_last(peer))
    robot.signal(signal.SIGCONT)
    home(physics)
    q, _ = move(physics, [0.5, 0.5], 25)
    np.testing.assert_allclose(q, 0.25, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "healthy", "reason"),
    [
        ({"fault_nan": 1.0}, {"fault_nan": 0.0}, "a position or velocity is not finite"),
        ({"fault_empty_velocity": True}, {"fault_empty_velocity": False}, "2 names, 2 positions and 0 velocities"),
        ({"fault_stop": True}, {"fault_stop": False}, "within 0.5 s"),
    ],
)
def test_states_that_cannot_be_used_end_in_zeros_and_an_error(start_robot, connect, peer, fault, healthy, reason):
    start_robot()
    physics = connect()
    move(physics, [0.5, 0.5], 5)
    set_fault(peer, **fault)
    with pytest.raises(RobotError, match=reason):
        move(physics, [0.5, 0.5], 10)
    wait_for(lambda: zeros_last(peer))
    set_fault(peer, **healthy)
    home(physics)
    assert np.isfinite(move(physics, [0.5, 0.5], 2)).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["-p", "state_joints:=[joint1, joint3]"], "joint 'joint2' is missing"),
        (["-r", f"{TOPIC}:=/elsewhere"], "no controller listens to /joint_velocity_controller/commands"),
    ],
)
def test_a_robot_that_cannot_be_driven_is_refused(start_robot, connect, options, reason):
    start_robot(*options)
    with pytest.raises(RobotError, match=reason):
        connect()


@pytest.mark.slow
def test_where_there_is_no_robot_one_line_says_so(connect):
    with pytest.raises(RobotError, match=r"^no joint state came on /joint_states within 5 s$"):
        connect()


@pytest.mark.slow
def test_a_robot_that_another_one_commands_is_left_alone(start_robot, connect, peer):
    start_robot()
    peer.publisher(Float64MultiArray, TOPIC)
    with pytest.raises(RobotError, match=f"another publisher commands {TOPIC}: peer"):
        connect()
    assert peer.commands == []


@pytest.mark.slow
def test_a_rival_who_comes_later_ends_the_episode_with_zeros(start_robot, connect, peer):
    start_robot()
    physics = connect()
    move(physics, [0.5, 0.5], 5)
    rival = peer.publisher(Float64MultiArray, TOPIC)
    with pytest.raises(RobotError, match="another publisher"):
        move(physics, [0.5, 0.5], 200)
    wait_for(lambda: zeros_last(peer))
    peer.remove(rival)
    home(physics)
    move(physics, [0.5, 0.5], 2)


@pytest.mark.slow
@pytest.mark.realtime
def test_an_arm_whose_caller_pauses_is_stopped(start_robot, connect, peer):
    start_robot()
    physics = connect()
    move(physics, [0.5, 0.5], 5)
    paused = time.monotonic()
    wait_for(lambda: zeros_last(peer))
    assert peer.commands[-1][0] - paused < 0.5
    move(physics, [0.5, 0.5], 5)


@pytest.mark.slow
def test_an_arm_whose_physics_is_forgotten_is_stopped(start_robot, connect, spec, peer):
    start_robot()
    connect().close()  # it sets the domain
    physics = RosPhysics(spec, 1, DT, 1, **OPTIONS)
    move(physics, [0.5, 0.5], 5)
    del physics
    gc.collect()
    wait_for(lambda: zeros_last(peer))
    wait_for(lambda: peer.node.count_publishers(TOPIC) == 0, what="its publisher is gone")


@pytest.mark.slow
@pytest.mark.parametrize("end", ["", "raise RuntimeError('a bug')", "os.kill(os.getpid(), signal.SIGINT)"])
def test_a_program_that_ends_in_any_way_leaves_a_standing_arm(start, start_robot, peer, end):
    start_robot()
    script = f"""
import os, signal
import numpy as np, gymnasium, physai
env = gymnasium.make("physai/RosReach-v0")
env.reset()
for _ in range(10):
    env.step(np.ones(2, np.float32))
{end}
"""
    program = start.run([sys.executable, "-c", script])
    wait_for(lambda: any(any(command) for _, command in peer.commands), 60.0, "a command")
    program.wait()
    wait_for(lambda: zeros_last(peer))
    assert [any(command) for _, command in peer.commands[-3:]] == [False] * 3, program.output


@pytest.mark.slow
def test_what_a_robot_behind_ros_cannot_do_is_refused_in_one_line(start_robot, connect, spec, peer):
    with pytest.raises(UserError, match="there is one robot behind ROS, not 2"):
        connect(robots=2)
    with pytest.raises(UserError, match=r"homing_speed: 9.0 rad/s is beyond the limit of 'planar_arm', 2.5 rad/s"):
        connect(homing_speed=9.0)
    start_robot()
    physics = connect()
    with pytest.raises(UserError, match=r"cannot be set; choose randomization=none"):
        physics.reset(ROW, RobotState(REST, REST), nominal_dynamics(spec))
    with pytest.raises(UserError, match="starts from rest"):
        physics.reset(ROW, RobotState(REST, REST + 1.0))
    with pytest.raises(UserError, match="must be finite"):
        physics.step(np.array([[0.5, np.nan]]))
    for question in (physics.state, physics.parameters):
        with pytest.raises(UserError, match="robot behind ROS"):
            question()
    assert not any(any(command) for _, command in peer.commands)
    physics.close()
    physics.close()


@pytest.mark.slow
@pytest.mark.realtime
def test_topics_can_have_other_names(start_robot, connect):
    start_robot("-r", "/joint_states:=/left/joint_states", "-r", f"{TOPIC}:=/left/commands")
    physics = connect(remap=["/joint_states:=/left/joint_states", f"{TOPIC}:=/left/commands"])
    q, _ = move(physics, [0.5, 0.5], 25)
    np.testing.assert_allclose(q, 0.25, atol=0.05)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_robot_is_found_in_its_namespace(start_robot, connect):
    start_robot("-r", "__ns:=/arm1")
    physics = connect(remap=["__ns:=/arm1"], reset_service="virtual_robot/reset")
    home(physics)
    position, _ = move(physics, [0.5, 0.0], 20)
    assert 0.1 < position[0, 0] < 0.3
