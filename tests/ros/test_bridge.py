"""The same task over topics: Gymnasium's rules, and policies of simulated robots on one behind ROS."""

import json
import shutil
import signal
import subprocess
import sys
import time
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import physai
from physai.envs.simulation import Simulation
from physai.physics import RobotState
from tests.waiting import wait_for

NAME = "physai/RosReach-v0"
WITHOUT_ROS = "import sys; sys.modules['rclpy'] = None\n"  # as if it were not installed


@pytest.fixture
def make(domain, monkeypatch):
    """Make the env in the test's domain; it is closed after the test."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    made = []

    def make_env(**options):
        made.append(gymnasium.make(NAME, **options))
        return made[-1]

    yield make_env
    for env in made:
        env.close()


@pytest.fixture
def run(exported_run, tmp_path):
    """A trained run that may be written to."""
    shutil.copytree(exported_run, tmp_path / "run")
    return tmp_path / "run"


def in_fresh_python(script):
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)


@pytest.mark.slow
def test_gymnasium_s_checker_passes_without_a_warning(start_robot, make):
    start_robot()
    env = make().unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


@pytest.mark.slow
def test_it_renders_and_closes_twice(start_robot, make):
    start_robot()
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (360, 480, 3)
    env.close()
    env.close()


@pytest.mark.slow
def test_a_second_env_takes_the_robot_over_and_the_first_says_so(start_robot, make):
    start_robot()
    first = make()
    first.reset(seed=0)
    second = make()
    second.reset(seed=0)
    with pytest.raises(physai.UserError, match="another one of this process has taken its robot over"):
        first.step(first.action_space.sample())
    second.step(second.action_space.sample())


@pytest.mark.slow
@pytest.mark.realtime
def test_an_episode_over_ros_is_the_episode_in_process(start_robot, make):
    start_robot()
    ours = make()
    theirs = gymnasium.make("physai/Reacher-v0", overrides=["env.start.spread=[0.0,0.0]"])
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    first, expected = (env.reset(seed=3)[0] for env in (ours, theirs))
    np.testing.assert_array_equal(first[-2:], expected[-2:])  # the goal
    np.testing.assert_allclose(first, expected, atol=0.02)
    for _ in range(25):
        (*seen, _), (*wanted, _) = (env.step(np.array([0.3, -0.2], np.float32)) for env in (ours, theirs))
        assert seen[2:] == wanted[2:]
    # The robot runs on a clock of its own: up to a period of 10 ms older, and its commands as much later.
    np.testing.assert_allclose(seen[0], wanted[0], atol=0.05)
    assert seen[1] == pytest.approx(wanted[1], abs=0.05)
    theirs.close()


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("name", ["panda_reach", "panda_pose"])
def test_an_arm_of_seven_joints_is_driven_and_seen_as_in_simulation(start_robot, peer, make, env_config, name):
    config = env_config(name)
    joints = config.robot.joints
    start_robot(env=name, state_joints=f"[{','.join(reversed(joints))}]")  # matched by name, not by place
    simulated, ours = Simulation(config, 1, seed=0), make(env=name)

    def compare(observation, info):
        shown = ours.unwrapped.simulation
        positions = shown.state.joint_position[0].tolist()

        def heard():
            return next((m for _, m in reversed(peer.joint_states) if m.position[::-1].tolist() == positions), None)

        message = wait_for(heard, what="the joint state that the env has seen")
        assert message.name == list(reversed(joints))
        state = RobotState(*(np.array([values[::-1]]) for values in (message.position, message.velocity)))
        sensed = {"joint_position": state.joint_position, "joint_velocity": state.joint_velocity, "goal": shown.goal}
        np.testing.assert_array_equal(observation, simulated.task.observe(sensed)[0])
        names = [tolerance.name for tolerance in simulated.task.tolerances]
        expected = dict(zip(names, simulated.task.error(state, shown.goal)[0].tolist(), strict=True))
        assert {key: info[key] for key in names} == expected
        return state.joint_position[0]

    observation, info = ours.reset(seed=3)
    start = compare(observation, info)
    np.testing.assert_allclose(start, config.robot.home, atol=0.02)
    action = np.array([0.3, -0.3, 0.3, 0.3, -0.3, 0.3, -0.3], np.float32)
    began = time.monotonic()
    for _ in range(25):
        observation, reward, terminated, truncated, info = ours.step(action)
        end = compare(observation, info)
        assert (np.isfinite(reward), terminated, truncated) == (True, False, False)
    elapsed = time.monotonic() - began
    expected = action * np.array(config.robot.command_limit)
    last = next(velocities for _, velocities in reversed(peer.commands) if any(velocities))  # zeros follow a stall
    np.testing.assert_allclose(last, expected, rtol=1e-6)
    seconds = (end - start) / expected
    np.testing.assert_allclose(seconds, seconds.mean(), atol=0.06)
    # 25 periods of 20 ms; a command holds for longer where the next one is late
    assert 0.44 < seconds.mean() < elapsed + 0.3
    simulated.close()


@pytest.mark.slow
def test_without_rclpy_one_line_says_what_to_install():
    done = in_fresh_python(
        WITHOUT_ROS + "import gymnasium, physai\n"
        "try: gymnasium.make('physai/RosReach-v0')\n"
        "except physai.UserError as error: print(error)\n"
    )
    assert done.stdout == "rclpy is not installed: pip install 'physai[ros]', or source ROS 2 Jazzy\n", done.stderr


@pytest.mark.slow
def test_the_other_envs_need_no_rclpy():
    done = in_fresh_python(WITHOUT_ROS + "import physai; physai.make_env('reacher', 2).close()")
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_where_there_is_no_robot_evaluate_says_so_in_one_line(start, run):
    command = start.run([sys.executable, "-m", "physai.evaluate", f"run={run}", "physics=ros"])
    assert command.wait(60.0) == 2
    assert command.says("error:") == "error: no joint state came on /joint_states within 5 s"
    assert not list(run.glob("evaluation_*"))


@pytest.mark.slow
def test_evaluate_refuses_to_randomize_a_robot_behind_ros(start, start_robot, peer, run):
    start_robot()
    command = start.command("evaluate", f"run={run}", "physics=ros", "randomization=default")
    assert command.wait(60.0) == 2
    assert "cannot be set; choose randomization=none" in command.says("error:")
    assert not any(any(velocity) for _, velocity in peer.commands)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_evaluation_leaves_a_standing_arm(start, start_robot, peer, run, number, code):
    start_robot()
    command = start.command("evaluate", f"run={run}", "physics=ros")
    wait_for(lambda: any(any(velocity) for _, velocity in peer.commands), 60.0, "a command")
    command.signal(number)
    assert command.wait() == code
    wait_for(lambda: [any(velocity) for _, velocity in peer.commands[-5:]] == [False] * 5)
    assert "Traceback" not in command.output
    assert not list(run.glob("evaluation_*"))


@pytest.mark.slow
@pytest.mark.realtime  # a robot that is silent for half a second ends the evaluation
def test_a_policy_reaches_the_same_goals_over_ros_as_in_process(start, start_robot, run):
    start_robot()
    here = ["env=reacher", "env.start.spread=[0.0,0.0]", "randomization=none"]
    for arguments in (["physics=ros"], here):
        command = start.command("evaluate", f"run={run}", "episodes=5", "in_a_row=0", *arguments)
        assert command.wait(280.0) == 0, command.output
    over_ros, in_process = (
        json.loads((run / f"evaluation_{name}_none.json").read_text()) for name in ("ros", "reacher")
    )
    for name, result in (("over ROS", over_ros), ("in process", in_process)):
        print(f"{name}: {result['success_rate']:.0%} of 5 goals, {result['steps_to_goal']:.1f} steps to goal")
    assert abs(over_ros["success_rate"] - in_process["success_rate"]) <= 1 / 5 + 1e-9
    assert over_ros["steps_to_goal"] == pytest.approx(in_process["steps_to_goal"], abs=5.0)
