"""The page of play as a person uses it: a real browser, a real mouse, a trained policy."""

import io
import re
import shutil
import time

import imageio.v3 as imageio
import numpy as np
import pytest

from physai.web.server import camera
from tests.waiting import wait_for

REACH = 0.55  # m, of the arm
SIZE = 800, 520
GREEN, ORANGE = (30, 180, 80), (242, 115, 31)  # the goal, the upper arm


def picture(page):
    return imageio.imread(io.BytesIO(page.locator("canvas").first.screenshot()))[..., :3].astype(float)


def colored(image, red, green, blue):
    """Pixels of about that hue, whatever the light is, [N, 2] as x and y; not those of what viser says in a corner."""
    wanted = np.array([red, green, blue], dtype=float)
    flat = image - image.min(axis=2, keepdims=True)
    near = (flat @ (wanted - wanted.min())) / (
        np.linalg.norm(flat, axis=2) * np.linalg.norm(wanted - wanted.min()) + 1e-9
    )
    mask = (near > 0.975) & (flat.max(axis=2) > 40)
    mask[:200, :330] = False
    return np.argwhere(mask)[:, ::-1]


class Camera:
    """Where points of the plane z = 0 are in a picture, and back; from where it is, and where it looks, m."""

    def __init__(self, image, place=None):
        self.height, self.width = image.shape[:2]
        self.position, target = map(np.array, place or camera(REACH))
        ahead = (target - self.position) / np.linalg.norm(target - self.position)
        right = np.cross(ahead, [0, 0, 1])
        right /= np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(ahead, right), ahead])  # x to the right, y down
        self.focal = self.height / 2 / np.tan(np.radians(75) / 2)

    def pixel(self, x, y):
        across, down, away = self.axes @ (np.array([x, y, 0.0]) - self.position)
        return self.width / 2 + self.focal * across / away, self.height / 2 + self.focal * down / away

    def point(self, x, y):
        ray = np.array([x - self.width / 2, y - self.height / 2, self.focal]) @ self.axes
        return (self.position - ray * self.position[2] / ray[2])[:2]


def distance(page):
    return float(re.search(r"goal: ([\d.]+) m", page.get_by_text("to the goal").inner_text())[1])


def counted(page, what):
    return int(re.search(rf"{what}: ([0-9]+)", page.get_by_text("settled:").inner_text())[1])


def upper_arm(image, seen):
    """Its pixels: those of the orange colour that are no farther from the base than it is long."""
    pixels = colored(image, *ORANGE)
    return pixels[[np.hypot(*seen.point(*pixel)) < 0.32 for pixel in pixels]]


def goal_of(page, seen):
    return seen.point(*np.median(colored(picture(page), *GREEN), axis=0))


def drawn(page):
    """Wait for two pictures: with one of them, the page finds out what is under the mouse."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.wait_for_timeout(50)


def drag_along_y(page, seen, start, end):
    """Take a goal by the arrow that shows the axis y, and let go of it at ``end``."""
    box = page.locator("canvas").first.bounding_box()
    for share in np.linspace(0.0, 1.0, 8):
        across, down = seen.pixel(start[0], start[1] + 0.08 + share * (end - start[1]))
        page.mouse.move(box["x"] + across, box["y"] + down)
        drawn(page)
        if share == 0.0:
            page.mouse.down()
            drawn(page)
    page.mouse.up()


@pytest.fixture
def page(new_page, serving, exported_run, tmp_path):
    shutil.copy(exported_run / "policy.pt", tmp_path)
    with serving("play", "run=policy.pt", "randomization=none", "seed=8") as address:
        page = new_page(*SIZE)
        page.goto(address)
        page.get_by_text("Goals by themselves").wait_for()
        yield page
        page.close()


@pytest.mark.slow
def test_an_arm_follows_the_goal_that_the_mouse_drags_and_stands_still_when_paused(page):
    """Of a policy file alone, in another folder; the half minute goes into pictures, which no other test looks at."""
    wait_for(lambda: len(colored(picture(page), *GREEN)) > 50)
    wait_for(lambda: distance(page) < 0.05)
    time.sleep(1.0)
    before = picture(page)
    seen = Camera(before)
    x, y = 0.269, 0.350  # of this seed
    assert goal_of(page, seen) == pytest.approx([x, y], abs=0.05)  # the arrow is green, too

    # Along the arrow that shows the axis y, to another place.
    there = -0.2
    drag_along_y(page, seen, (x, y), there)
    wait_for(lambda: np.abs(goal_of(page, seen) - [x, there]).max() < 0.1, 30.0)
    wait_for(lambda: distance(page) < 0.05)
    time.sleep(1.0)
    after = picture(page)

    # The upper arm is orange, with its middle where middles are; the forearm is between its end and the goal.
    base = np.array(seen.pixel(0.0, 0.0))
    for image, other in ((before, after), (after, before)):
        arm = upper_arm(image, seen)
        assert np.linalg.norm(seen.point(*np.median(arm, axis=0))) == pytest.approx(0.15, abs=0.06)
        elbow = arm[np.linalg.norm(arm - base, axis=1).argmax()]
        column, row = ((elbow + np.median(colored(image, *GREEN), axis=0)) / 2).astype(int)
        around = slice(row - 6, row + 7), slice(column - 6, column + 7)
        assert np.abs(image[around] - other[around]).max() > 40

    page.get_by_role("button", name="Pause").click()
    time.sleep(0.5)
    paused = picture(page)
    page.get_by_role("button", name="Another goal").click()
    wait_for(lambda: np.abs(goal_of(page, seen) - [x, there]).max() > 0.1)
    still = np.median(upper_arm(picture(page), seen), axis=0)
    assert still == pytest.approx(np.median(upper_arm(paused, seen), axis=0), abs=3.0)

    far = distance(page)
    for _ in range(5):
        page.get_by_role("button", name="Step").click()
    wait_for(lambda: far - distance(page) > 0.002)
    time.sleep(1.0)
    stepped = distance(page)
    time.sleep(1.0)
    assert distance(page) == stepped

    menus = page.locator("input.mantine-Select-input").all()
    next(menu for menu in menus if menu.input_value() == "pybullet").click()
    page.get_by_role("option", name="mujoco").click()
    page.get_by_role("button", name="Go on").click()
    wait_for(lambda: distance(page) < 0.05)  # of the other engine's robot, which has a goal of its own
    assert counted(page, "Goals") == 1
    page.get_by_role("button", name="Reset").click()
    wait_for(lambda: counted(page, "reached") == 0)


@pytest.fixture
def walk_page(new_page, serving, walking_run, tmp_path):
    shutil.copy(walking_run / "policy.pt", tmp_path)
    with serving("play", "run=policy.pt", "randomization=none") as address:
        page = new_page(*SIZE)
        page.goto(address)
        page.get_by_text("Asked for").wait_for()
        yield page
        page.close()


@pytest.mark.slow
def test_legs_walk_on_the_spot_as_the_sliders_ask(walk_page):
    """Half a minute, for its meshes: nothing else shows that sliders reach a robot, and that legs are drawn."""
    before = picture(walk_page)
    assert (before.max(axis=2) < 90).sum() > 1000  # the trunk is black
    time.sleep(0.5)
    assert np.abs(picture(walk_page) - before).max() > 40  # its legs, and the floor below them

    ahead, turn = walk_page.locator("input.mantine-NumberInput-input").all()[1:3]  # the first is that of speed
    for value, low, high in (("0.8", 0.6, 1.1), ("0", 0.0, 0.15)):
        for number, text in ((ahead, value), (turn, "0")):
            number.fill(text)
            number.press("Enter")
        wait_for(lambda low=low, high=high: low <= speed(walk_page) <= high)
    assert walk_page.get_by_text("Falls: 0").is_visible()


def speed(page):
    return float(re.search(r"walks at ([\d.]+) m/s", page.get_by_text("It walks at").inner_text())[1])
