"""The dashboard as a person uses it: a real browser, a real mouse, a robot behind real nodes."""

import time

import numpy as np
import pytest

from tests.ros.loop import Arm
from tests.ros.test_dashboard import dashboard
from tests.waiting import wait_for
from tests.web.conftest import new_page  # noqa: F401  # a fixture
from tests.web.test_play import GREEN, REACH, Camera, colored, drag_along_y, picture

SIZE = 700, 450
SEEN_FROM = ((0.0, -0.9 * REACH, 1.1 * REACH), (0.0, 0.0, 0.0))  # of one robot


@pytest.fixture
def arm(peer):
    made = Arm(peer)
    yield made
    made.leave()


@pytest.fixture
def page(start, arm, peer, policy_path, new_page):  # noqa: F811
    start("inference_node", policy_path=policy_path, autostart=True)
    peer.wait_state("waiting", timeout=60.0)
    _, address = dashboard(start)
    page = new_page(*SIZE)
    page.goto(address)
    page.get_by_text("This page is a convenience").wait_for()
    yield page
    page.close()


def goal_of(page, seen):
    """Where the goal is drawn; the plate below the base is green, too."""
    points = [seen.point(*pixel) for pixel in colored(picture(page), *GREEN)]
    return np.median([point for point in points if np.hypot(*point) > 0.2], axis=0)


def drag(page, seen, end, done):
    """Drag the goal to another y until something is done; again, if the page was too slow."""

    def try_it():
        drag_along_y(page, seen, goal_of(page, seen), end)
        deadline = time.monotonic() + 3.0
        while not (found := done()) and time.monotonic() < deadline:
            time.sleep(0.1)
        return found

    wait_for(try_it, 120.0)


@pytest.mark.slow
def test_a_goal_that_is_dragged_is_reached_a_stuck_arm_says_so_and_stop_all_stops_it(page, arm, peer, tmp_path):
    wait_for(lambda: len(colored(picture(page), *GREEN)) > 50, 60.0)
    time.sleep(1.0)
    before = picture(page)
    page.screenshot(path=tmp_path / "before.png")
    seen = Camera(before, SEEN_FROM)
    tip = np.array([0.3 + 0.25 * np.cos(0.5), 0.25 * np.sin(0.5)])  # at home; there the goal waits to be dragged
    assert goal_of(page, seen) == pytest.approx(tip, abs=0.06)

    drag(page, seen, -0.05, lambda: arm.position[0] < -0.1)
    peer.wait_state("reached", timeout=60.0)
    page.get_by_text("reached").first.wait_for()
    after = picture(page)
    assert np.abs(after - before).max(axis=2).mean() > 0.5  # the arm is drawn elsewhere
    page.screenshot(path=tmp_path / "reached.png")

    stuck = list(arm.position)

    def freeze(message):
        message.position, message.velocity = stuck, [0.0, 0.0]
        return message

    arm.change = freeze
    peer.send_goal(-0.3, -0.2)
    peer.wait_state("fault", timeout=60.0)
    page.get_by_text("is stuck").first.wait_for()  # in words
    page.screenshot(path=tmp_path / "fault.png")

    arm.go_home()
    page.get_by_role("button", name="Reset").click()
    peer.wait_state("waiting", timeout=60.0)
    peer.send_goal(-0.3, -0.2)
    since = time.monotonic()
    peer.moved(after=since)
    page.get_by_role("button", name="STOP ALL").click()
    peer.wait_state("estop")
    wait_for(lambda: not any(peer.commands[-1][1]), what="zeros")
    page.get_by_text("estop").first.wait_for()
    page.screenshot(path=tmp_path / "stopped.png")
