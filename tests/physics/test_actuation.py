"""Commands on their way: each robot gets its own as many control steps late as its delay says."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from physai.physics import ActuatorDelay

ROBOTS, JOINTS = 4, 2
STANDING = np.arange(ROBOTS * JOINTS, dtype=float).reshape(ROBOTS, JOINTS) / 10


def delayed(delays, rows=None, standing=STANDING) -> ActuatorDelay:
    delay = ActuatorDelay(ROBOTS, JOINTS)
    delay.reset(np.arange(ROBOTS) if rows is None else rows, standing, np.array(delays))
    return delay


def command(step: int) -> np.ndarray:
    """Says of which robot and step it is."""
    return 100.0 * step + np.arange(ROBOTS)[:, None] + np.array([0.0, 0.5])


def test_without_a_delay_a_command_arrives_at_once():
    delay = ActuatorDelay(ROBOTS, JOINTS)
    for step in range(3):
        np.testing.assert_array_equal(delay(command(step)), command(step))


def test_each_robot_gets_its_commands_as_late_as_its_own_delay_says():
    delays = [0, 1, 3, 2]
    delay = delayed(delays)
    for step in range(10):
        arriving = delay(command(step))
        for robot, late in enumerate(delays):
            expected = command(step - late)[robot] if step >= late else STANDING[robot]
            np.testing.assert_array_equal(arriving[robot], expected, err_msg=f"step {step}, robot {robot}")


def test_a_reset_robot_forgets_what_was_under_way_and_stands_until_its_first_command_arrives():
    delay = delayed([2, 2, 2, 2])
    for step in range(5):
        delay(command(step))
    delay.reset(np.array([1, 3]), np.full((2, JOINTS), -7.0))
    for step in range(5, 9):
        arriving = delay(command(step))
        np.testing.assert_array_equal(arriving[[0, 2]], command(step - 2)[[0, 2]])
        expected = command(step - 2)[[1, 3]] if step >= 7 else np.full((2, JOINTS), -7.0)
        np.testing.assert_array_equal(arriving[[1, 3]], expected)


def test_a_reset_without_new_delays_keeps_the_old_ones():
    delay = delayed([1, 1, 1, 1])
    delay.reset(np.array([0]), STANDING[:1])
    np.testing.assert_array_equal(delay(command(0)), STANDING)
    np.testing.assert_array_equal(delay(command(1)), command(0))


@given(
    first=st.lists(st.integers(0, 6), min_size=ROBOTS, max_size=ROBOTS),
    longer=st.integers(0, 12),
    robot=st.integers(0, ROBOTS - 1),
    at=st.integers(0, 12),
)
def test_a_delay_that_is_longer_than_any_before_leaves_the_other_robots_alone(first, longer, robot, at):
    disturbed, quiet = delayed(first), delayed(first)
    others = np.arange(ROBOTS) != robot
    for step in range(at + 14):
        if step == at:
            disturbed.reset(np.array([robot]), STANDING[[robot]], np.array([longer]))
        arriving = disturbed(command(step))
        np.testing.assert_array_equal(arriving[others], quiet(command(step))[others])
        if step >= at:
            expected = command(step - longer)[robot] if step - longer >= at else STANDING[robot]
            np.testing.assert_array_equal(arriving[robot], expected)


def test_a_state_goes_on_bit_for_bit_in_another_instance_and_does_not_change_later():
    delay = delayed([0, 3, 1, 2])
    for step in range(5):
        delay(command(step))
    state = delay.state()
    copy = {key: value.copy() for key, value in state.items()}
    expected = [delay(command(step)) for step in range(5, 12)]
    delay.reset(np.arange(ROBOTS), STANDING, np.array([5, 5, 5, 5]))
    for key, value in copy.items():
        np.testing.assert_array_equal(state[key], value)
    for _ in range(2):
        restored = ActuatorDelay(ROBOTS, JOINTS)
        restored.set_state(state)
        np.testing.assert_array_equal([restored(command(step)) for step in range(5, 12)], expected)


def test_commands_that_arrived_are_not_changed_by_later_ones():
    delay = delayed([1, 0, 2, 1])
    arrived = [delay(command(step)) for step in range(6)]
    copies = [value.copy() for value in arrived]
    delay.reset(np.arange(ROBOTS), STANDING)
    delay(command(9))
    np.testing.assert_array_equal(arrived, copies)
