"""The dashboard beside real nodes: what it does to robots is what is asked, and nothing else."""

import contextlib
import re
import signal
import subprocess
import sys
import time

import pytest
from geometry_msgs.msg import PointStamped
from std_msgs.msg import Bool

from tests.ros.test_fleet import Robot
from tests.waiting import wait_for
from tests.web.visitor import Visitor, shows

ARM = ("-r", "__ns:=/arm1")


def dashboard(start, **parameters) -> tuple:
    """Start one; return its process and its address."""
    process = start("dashboard", port=0, **parameters)
    return process, re.search(r"http://[\d.]+:\d+", process.says("may watch", 60.0)).group()


@pytest.fixture
def robot(start, peer, policy_path):
    """A virtual robot in /arm1, driven and waiting for a goal."""
    start("virtual_robot", *ARM, rate_hz=50.0)
    start("inference_node", *ARM, policy_path=policy_path, autostart=True)
    found = Robot(peer, "/arm1")
    wait_for(lambda: found.is_in("waiting"), 60.0, "a robot that waits for a goal")
    return found


@pytest.mark.slow
def test_what_happens_to_the_page_changes_nothing_on_a_robot(start, peer, robot):
    """Some seconds: stopped, asked meanwhile, flooded and killed."""
    process, address = dashboard(start)
    host, port = address.removeprefix("http://").split(":")
    goals: list[tuple[float, PointStamped]] = []
    stops: list[tuple[float, Bool]] = []
    peer.listen(PointStamped, "/arm1/inference_node/goal", goals, 10)
    peer.listen(Bool, "/emergency_stop", stops, 10)
    visitor = Visitor(host, int(port))
    marker = "/robot_arm1/goal"
    wait_for(lambda: shows(visitor, marker), 30.0, "a goal to drag")

    process.signal(signal.SIGSTOP)
    time.sleep(1.0)
    visitor.drag(marker, (0.3, 0.2, 0.0))  # nobody expects it any more when the page goes on
    process.signal(signal.SIGCONT)
    time.sleep(2.0)
    assert not goals
    visitor.drag(marker, (0.3, 0.2, 0.0), release=False)
    for _ in range(100):
        visitor.socket.send(bytes(1000))
    crowd = []
    for _ in range(100):
        with contextlib.suppress(Exception):
            crowd.append(Visitor(host, int(port)))
    assert len(crowd) == 15
    for each in crowd:
        each.socket.socket.close()
    visitor.socket.socket.close()  # in the middle of its drag
    time.sleep(1.0)
    assert not goals
    assert process.poll() is None

    def enter() -> Visitor | None:  # there is room once the page has found that the others have gone
        with contextlib.suppress(Exception):
            return Visitor(host, int(port))

    other = wait_for(enter, 30.0, "room for another visitor")
    wait_for(lambda: shows(other, marker), 30.0, "the page again")

    def let_go() -> bool:  # a page that had no time for half a second does not do what was asked meanwhile
        other.drag(marker, (0.3, 0.1, 0.0), (-0.3, -0.2, 0.0))
        time.sleep(1.5)
        return bool(goals)

    wait_for(let_go, 30.0, "a goal that was let go")
    assert {(round(goal.point.x, 3), round(goal.point.y, 3)) for _, goal in goals} == {(-0.3, -0.2)}
    wait_for(robot.moves, 10.0, "a robot that follows the page")
    process.signal(signal.SIGKILL)
    process.wait()
    time.sleep(1.0)
    wait_for(lambda: robot.states[-1][1] in ("active", "reached"), 5.0, "a robot that goes on")
    assert not stops


@pytest.mark.realtime  # a robot that has not stopped in time is asked, too
def test_robots_come_and_go_and_come_back(start, peer, policy_path, robot):
    from physai.ros.live.robots import Ask, Robots

    # The first words of a process take ROS a tenth of a second, in which it looks through all that is imported, and
    # nothing is heard. A dashboard has spoken before.
    peer.node.get_logger().info("looking for robots")
    robots = Robots(peer.node, True)
    peer.node.create_timer(0.1, robots.look)
    (status,) = wait_for(lambda: robots.all, 10.0, "a robot that is found")
    wait_for(lambda: status.present and status.joint_position and status.goal_description and status.words, 10.0)
    assert set(status.joint_position) == {"joint1", "joint2"}
    node = start("inference_node", "-r", "__ns:=/arm2", policy_path=policy_path)
    wait_for(lambda: len(robots.all) == 2 and robots.all[1].present and robots.all[1].state, 30.0)
    robots.ask(Ask("reset", "/arm2", at=time.monotonic() - 1.0))
    wait_for(lambda: "came too late" in robots.all[1].said, 5.0)
    wait_for(robots._links["/arm2"]._stop.get_subscription_count, what="a robot that hears its stop")
    robots.ask(Ask("stop", "/arm2", at=time.monotonic() - 1.0))  # never too late
    wait_for(lambda: robots.all[1].state == "estop", 10.0, "one robot that has stopped")
    assert not robot.is_in("estop")
    node.end()
    wait_for(lambda: not robots.all[1].present, 20.0, "a robot that is missed")
    node = start("inference_node", "-r", "__ns:=/arm2", "-r", "/emergency_stop:=/halt", policy_path=policy_path)
    wait_for(lambda: robots.all[1].present and robots.all[1].state == "estop", 30.0, "a robot that is back")
    wait_for(lambda: peer.call("/arm2/inference_node/reset").success, 10.0, "a reset")
    wait_for(lambda: robots.all[1].state == "waiting", 10.0, "a robot that waits")
    robots.ask(Ask("stop all"))
    wait_for(lambda: all(each.state == "estop" for each in robots.all), 10.0, "all, that with a topic of its own, too")
    assert [each.said.startswith("estop") for each in robots.all] == [False, True]  # who hears it is not asked twice


@pytest.mark.slow
def test_bad_parameters_end_it_in_one_line_and_beyond_localhost_nobody_commands_unasked(start, tmp_path):
    (tmp_path / "token").write_text("short")
    for parameters, said in (
        ({"commands": "perhaps"}, "commands: must be 'auto' or 'true' or 'false', got 'perhaps'"),
        ({"host": "192.0.2.1"}, "cannot listen on 192.0.2.1"),
        (
            {"host": "127.0.0.2", "commands": "true", "token_file": tmp_path / "token"},
            "needs at least 16 letters, digits, - or _",
        ),
    ):
        process = start("dashboard", port=0, **parameters)
        assert process.wait(60) == 2
        assert said in process.output
    process = start("dashboard", port=0, host="127.0.0.2")
    assert "nobody may command" in process.says("everyone who reaches this address may watch", 60.0)
    process = start("dashboard", port=0, host="127.0.0.2", commands=True)
    process.says("?token=", 60.0)


@pytest.mark.slow
def test_without_its_extra_one_line_names_it():
    code = "import sys; sys.modules['viser'] = None; from physai.ros.dashboard import main; sys.exit(main())"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert ran.returncode == 2
    assert ran.stderr == "error: the dashboard needs 'viser', which is not installed: pip install 'physai[web]'\n"
