"""Tables and recordings, whole and spoilt."""

import dataclasses

import numpy as np
import pytest

from physai.bench.hidden import record, write_table
from physai.errors import UserError
from physai.identify.recording import Recording, _on_grid, read
from physai.identify.trials import cut
from tests.composed import randomization

TOPIC = "/joint_velocity_controller/commands"


@pytest.fixture(scope="module")
def hidden(env_config):
    draws = randomization("none")
    return record(env_config("reacher", "physics=mujoco"), draws, [], 12.0, 0, feels=True)


@pytest.fixture
def table(hidden, tmp_path):
    path = tmp_path / "robot.csv"
    write_table(hidden.recording, hidden.spec.joints, path)
    return path


def read_table(path):
    return read(path, ("joint1", "joint2"), 0.02, TOPIC)


def test_a_table_says_what_was_recorded(hidden, table):
    seen = read_table(table)
    for key in ("position", "velocity", "command", "effort"):
        np.testing.assert_allclose(getattr(seen, key), getattr(hidden.recording, key), rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (lambda text: text.replace("position[joint2]", "position[joint_2]"), "no column 'position[joint2]'; did you"),
        (lambda text: text.replace("time,", "stamp,"), "no column 'time'"),
        (lambda text: text.replace("\n0.2,", "\nnoon,"), "column 'time' holds something that is no number"),
        (lambda text: text.replace("\n4,", "\n1,"), "the clock of its joint states goes back by 2.98 s at number 200"),
        (lambda text: text.replace("\n4,", "\n4000,"), "goes on by 4e+03 s at number 200"),
        (lambda text: text.replace("\n4,", "\n,"), "a time of its joint states is not finite"),
        (lambda text: "\n".join(text.split("\n")[::2]), "every 40 ms, and the control period of the env is only 20 ms"),
        (lambda text: text.split("\n")[0], "it holds 0 joint states"),
        (lambda _: "", "No columns to parse"),
    ],
)
def test_a_spoilt_table_is_refused_in_one_line(table, spoil, line):
    table.write_text(spoil(table.read_text()))
    with pytest.raises(UserError) as caught:
        read_table(table)
    assert line in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(("parts", "period"), [(2, 0.01), (4, 0.005), (20, 0.005), (2.5, 0.008)])
def test_joint_states_that_come_faster_than_commands_make_finer_steps(tmp_path, parts, period):
    count = int(200 * parts)
    time = 0.02 / parts * np.arange(count)[:, None]
    position, command = np.hstack([np.sin(time), np.cos(time)]), np.floor(time / 0.02 + 1e-9)
    fast = Recording(0.02 / parts, position, np.zeros((count, 2)), np.hstack([command, -command]), np.zeros((count, 2)))
    write_table(fast, ("joint1", "joint2"), tmp_path / "fast.csv")
    seen = read_table(tmp_path / "fast.csv")
    assert seen.period == pytest.approx(period)
    grid = period * np.arange(len(seen))
    np.testing.assert_allclose(seen.position[:, 0], np.sin(grid), rtol=0, atol=1e-6)
    assert np.isfinite(seen.command).all()


def test_with_lost_rows_their_commands_are_lost_and_the_rest_is_as_it_was(hidden, table):
    lines = table.read_text().split("\n")
    table.write_text("\n".join(line for number, line in enumerate(lines) if not 200 < number <= 204))
    seen = read_table(table)
    assert len(seen) == len(hidden.recording)
    lost = np.isnan(seen.position).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(lost), range(200, 204))
    np.testing.assert_array_equal(np.isnan(seen.command).all(axis=1), lost)
    np.testing.assert_allclose(seen.position[~lost], hidden.recording.position[~lost], rtol=0, atol=1e-7)


def test_motions_begin_where_commands_change_after_a_rest(hidden):
    trials = cut(hidden.recording, "robot", hidden.spec)
    assert len(trials) >= 3
    assert not trials.before.any()
    assert trials.command[0].any(axis=1).all()
    np.testing.assert_allclose(trials.noise[:2], [[1e-3] * 2, [2e-2] * 2], rtol=0.25)
    assert np.isfinite(trials.measured).any(axis=(0, 1, 3)).all()


def test_the_motion_in_which_a_motor_was_strongest_is_not_held_out(hidden):
    trials = cut(hidden.recording, "robot", hidden.spec)
    assert trials.held_out.sum() == 1
    for number in range(len(trials)):
        measured = trials.measured.copy()
        measured[2] = np.arange(len(trials))[:, None] == number
        assert not dataclasses.replace(trials, measured=measured).held_out[number]


@pytest.mark.parametrize(("motions", "joints"), [(2, 1), (2, 7), (5, 7), (8, 7), (40, 2)])
@pytest.mark.parametrize("told", [0, 1, 2], ids=["nothing", "velocities", "efforts, too"])
def test_a_quarter_is_held_out_and_one_motion_at_least_however_few_there_are(hidden, motions, joints, told):
    random, trials = np.random.default_rng(motions), cut(hidden.recording, "robot", hidden.spec)
    measured = random.normal(size=(3, 10, motions, joints))
    measured[1 + told :] = np.nan
    anywhere = np.zeros((motions, joints))
    held_out = dataclasses.replace(trials, measured=measured, start=anywhere).held_out
    assert held_out.sum() == max(1, motions // 4)
    assert not held_out.all()


def moving_before(hidden, speed, told):
    """The first motion begins at a speed; whether the velocities that were measured say so, too."""
    recording = hidden.recording
    first = int(np.flatnonzero(recording.command.any(axis=1))[0])
    time = recording.period * np.arange(-first, 0)[:, None]
    command, position, velocity = recording.command.copy(), recording.position.copy(), recording.velocity.copy()
    command[:first], position[:first] = 0.5, position[:first] + np.cumsum(speed(time), axis=0) * recording.period
    position[first:] += position[first - 1] - recording.position[first - 1] + speed(0.0) * recording.period
    velocity[:first] += told * speed(time)
    velocity[first] += told * speed(0.0)
    return first, dataclasses.replace(recording, command=command, position=position, velocity=velocity)


@pytest.mark.parametrize("slower", [0.0, 0.3])
def test_a_motion_may_begin_at_a_speed_that_hardly_changes(hidden, slower):
    whole = cut(hidden.recording, "robot", hidden.spec)
    first, recording = moving_before(hidden, lambda time: 0.5 - slower * np.asarray(time), 1.0)
    steady = cut(recording, "robot", hidden.spec)
    assert len(steady) == len(whole)
    assert not steady.left_out
    np.testing.assert_allclose(steady.velocity[0], 0.5, atol=0.03)
    off = steady.start[0] - (recording.position[first] - hidden.recording.position[first])  # it stood at zero
    assert (np.abs(off) < 3 * steady.start_noise[0]).all()
    assert 1.5 < steady.start_noise[0] / whole.start_noise[0] < 2.5
    np.testing.assert_array_equal(steady.velocity[1:], 0.0)
    np.testing.assert_allclose(steady.noise, whole.noise, rtol=0.1)


@pytest.mark.parametrize(
    ("slower", "told", "line"),
    [(2.0, 1.0, "its speed still changes when it begins"), (0.0, 0.0, "positions and velocities that were measured")],
)
def test_a_motion_whose_beginning_is_not_known_is_left_out_and_it_is_said_why(hidden, slower, told, line):
    whole = cut(hidden.recording, "robot", hidden.spec)
    first, recording = moving_before(hidden, lambda time: 0.5 - slower * np.asarray(time), told)
    steady = cut(recording, "robot", hidden.spec)
    assert len(steady) == len(whole) - 1
    (why,) = steady.left_out
    assert why.startswith(f"at {first * 0.02:.2f} s: {line}")


def test_a_motion_ends_where_a_command_is_not_known_and_it_is_said(hidden):
    command = hidden.recording.command.copy()
    whole = cut(hidden.recording, "robot", hidden.spec)
    first = int(np.flatnonzero(command.any(axis=1))[0])
    command[first + 20] = np.nan
    trials = cut(dataclasses.replace(hidden.recording, command=command), "robot", hidden.spec)
    assert len(trials) == len(whole)
    assert np.isfinite(trials.measured[0, :, 0, 0]).sum() == 20
    assert trials.left_out == (f"at {first * 0.02:.2f} s: no command is known from {first * 0.02 + 0.4:.2f} s on",)


@pytest.mark.parametrize("side", [0, 1])
def test_a_motion_ends_before_a_joint_comes_to_its_limit_and_none_begins_beyond_it(hidden, side):
    """What the limit does to the joint there says nothing of the robot that is looked for."""
    whole = cut(hidden.recording, "robot", hidden.spec)
    begin, end = (round(each / hidden.recording.period) for each in whole.begins[1:3])
    position = hidden.recording.position.copy()
    position[begin + 30 : end + 1, 1] = 1.02 * hidden.spec.position_limit[1, side]
    position[begin + 31] = np.nan
    trials = cut(dataclasses.replace(hidden.recording, position=position), "robot", hidden.spec)
    assert list(trials.begins) == [each for each in whole.begins if each != whole.begins[2]]
    assert np.isfinite(trials.measured[0, :, 1, 0]).sum() == 29
    at, until, last = whole.begins[1], whole.begins[1] + 0.6, whole.begins[2]
    comes = "at {:.2f} s: 'joint2' comes to its limit at {:.2f} s, and nothing is used from there on"
    assert trials.left_out == (comes.format(at, until), comes.format(last, last), f"at {last:.2f} s: too short")


def test_a_joint_may_leave_a_limit_at_which_it_rests(hidden):
    whole = cut(hidden.recording, "robot", hidden.spec)
    at, position = whole.start[0, 1], hidden.recording.position.copy()
    position[:, 1] = at + np.abs(position[:, 1] - at)
    rests = dataclasses.replace(hidden.spec, position_limit=np.array([[-np.inf, np.inf], [at, np.inf]]))
    assert cut(dataclasses.replace(hidden.recording, position=position), "robot", rests).begins[0] == whole.begins[0]


def test_of_a_long_recording_motions_from_all_over_it_are_used(hidden):
    again = {
        key: np.tile(getattr(hidden.recording, key), (15, 1)) for key in ("position", "velocity", "command", "effort")
    }
    trials = cut(dataclasses.replace(hidden.recording, **again), "robot", hidden.spec)
    assert len(trials) == 40
    assert "all but 40 of" in trials.left_out[-1]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda command, position: (np.sin(np.arange(len(command)))[:, None] + command, position), "0 motions begin"),
        (lambda command, position: (command, position[:20].repeat(len(command) // 20, axis=0)), "'joint1' moves by"),
    ],
)
def test_motions_that_tell_nothing_are_refused_in_one_line(hidden, change, line):
    recording = hidden.recording
    command, position = change(recording.command, recording.position)
    with pytest.raises(UserError, match=line) as caught:
        cut(
            Recording(recording.period, position, recording.velocity, command, recording.effort),
            "robot",
            hidden.spec,
        )
    assert len(str(caught.value).splitlines()) == 1


def test_a_recording_of_topics_says_the_same_as_a_table(hidden, tmp_path):
    bags = pytest.importorskip("physai.ros.recording.bag")
    recording, types = hidden.recording, bags.TYPES.types
    bag = bags.Bag(tmp_path / "bag")
    kinds = {"/joint_states": "sensor_msgs/msg/JointState", TOPIC: "std_msgs/msg/Float64MultiArray"}
    for topic, kind in kinds.items():
        bag.add(topic, kind)
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "")
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    random = np.random.default_rng(0)
    for step in range(len(recording)):
        at = round((100.0 + 0.02 * step + random.uniform(0.0, 0.002)) * 1e9)
        # The driver has more joints, in another order.
        measured = (recording.position, recording.velocity, recording.effort)
        position, velocity, effort = (np.append(values[step][::-1], 7.0) for values in measured)
        states = types[kinds["/joint_states"]](header, ["joint2", "joint1", "finger"], position, velocity, effort)
        command = types[kinds[TOPIC]](layout, recording.command[step])
        for topic, late, message in (("/joint_states", 0, states), (TOPIC, 1_000_000, command)):
            bag.write(topic, kinds[topic], at + late, bytes(bags.TYPES.serialize_cdr(message, kinds[topic])))
    bag.close()
    seen = read_table(tmp_path / "bag")
    for key in ("position", "velocity", "command", "effort"):
        np.testing.assert_allclose(getattr(seen, key), getattr(recording, key), rtol=0, atol=1e-7)
    with pytest.raises(UserError, match="has no joint 'elbow'"):
        read(tmp_path / "bag", ("joint1", "elbow"), 0.02, TOPIC)
    with pytest.raises(UserError, match="it holds no /other"):
        read(tmp_path / "bag", ("joint1", "joint2"), 0.02, "/other")


def test_states_that_come_in_a_burst_at_the_start_leave_the_last_command_as_it_is(tmp_path):
    time = np.concatenate([[0.0, 0.001, 0.002], 0.02 * np.arange(1, 101)])  # a driver that was late with its first ones
    states = np.column_stack([time, np.zeros((len(time), 6))])
    commands = np.column_stack([0.011 + 0.02 * np.arange(100), np.full((100, 2), 0.5)])
    seen = _on_grid(tmp_path, states, commands, 0.02)
    assert len(seen) == 101
    assert (seen.command[1:] == 0.5).all()
