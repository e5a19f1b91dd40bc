import math
import random
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from physai.errors import UserError
from physai.robots import RobotConfig, RobotSpec
from physai.robots.urdf import resolve
from tests.composed import env_config

CONFIG = env_config("reacher").robot
TEXT = resolve(CONFIG.urdf).read_text()
LINK2 = TEXT[TEXT.index('<link name="link2">') : TEXT.index('<joint name="tool_mount"')]


def spec_of(path: Path | str, **changes: object) -> RobotSpec:
    return RobotSpec.from_config(RobotConfig.model_validate({**CONFIG.model_dump(), "urdf": str(path), **changes}))


def message_of(path: Path | str, **changes: object) -> str:
    with pytest.raises(UserError) as caught:
        spec_of(path, **changes)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    return message


def replaced(old: str, new: str, after: str = "") -> str:
    start = TEXT.index(after)
    assert old in TEXT[start:]
    return TEXT[:start] + TEXT[start:].replace(old, new, 1)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "arm.urdf"


def test_the_planar_arm_is_what_its_urdf_says():
    spec = spec_of(CONFIG.urdf)
    assert spec.joints == ("joint1", "joint2")
    assert spec.moving_links == ("link1", "link2", "tool")
    np.testing.assert_allclose(spec.link_mass, [1.0, 0.6, 0.05])
    assert spec.position_limit.tolist() == [[-math.inf, math.inf], [-2.6, 2.6]]
    assert spec.continuous.tolist() == [True, False]
    np.testing.assert_allclose(spec.effort_limit, [5.0, 3.0])
    np.testing.assert_allclose(spec.velocity_limit, [2.5, 2.5])
    np.testing.assert_allclose(spec.damping, [0.05, 0.03])
    np.testing.assert_allclose(spec.friction, [0.05, 0.03])


def test_a_continuous_joint_has_no_limits_whatever_its_limit_says(path):
    path.write_text(replaced('<joint name="joint2" type="revolute">', '<joint name="joint2" type="continuous">'))
    spec = spec_of(path)
    assert spec.position_limit.tolist() == [[-math.inf, math.inf]] * 2
    assert spec.continuous.tolist() == [True, True]
    np.testing.assert_allclose(spec.effort_limit, [5.0, 3.0])


def test_the_kuka_turns_no_joint_without_end(kuka_reacher):
    assert RobotSpec.from_config(kuka_reacher.robot).continuous.tolist() == [False, False]


def test_a_missing_file_is_named(tmp_path):
    message = message_of(tmp_path / "nowhere.urdf")
    assert "nowhere.urdf" in message
    assert "no such" in message


@pytest.mark.parametrize(
    "uri",
    ["package://no_such_package_here/arm.urdf", "package://no.such.package/arm.urdf", "package:///arm.urdf"],
)
def test_an_unknown_package_is_named(uri):
    message = message_of(uri)
    assert uri in message
    assert "package" in message


def test_a_missing_file_in_a_package_is_named():
    assert "robots/assets/arm.urdf" in message_of("package://physai/robots/assets/arm.urdf")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TEXT.replace("</robot>", ""), ["XML"]),
        ("", ["XML"]),
        ("this is no XML", ["XML"]),
        ("<sdf/>", ["<robot", "<sdf>"]),
        (replaced('<parent link="link1"/>', '<parent link="lnik1"/>'), ["joint2", "parent", "lnik1"]),
        (replaced('<child link="link2"/>', '<child link="link9"/>'), ["joint2", "child", "link9"]),
        (replaced('<child link="link2"/>', ""), ["joint2", "child"]),
        (replaced('<mass value="0.6"/>', '<mass value="abc"/>'), ["link2", "mass", "'abc'"]),
        (replaced('<mass value="0.6"/>', '<mass value=""/>'), ["link2", "mass"]),
        (replaced('<mass value="0.6"/>', '<mass value="0.6 0.7"/>'), ["link2", "mass"]),
        (replaced('<mass value="0.6"/>', "<mass/>"), ["link2", "mass"]),
        (replaced('<mass value="0.6"/>', '<mass value="nan"/>'), ["link2", "mass", "nan"]),
        (replaced('<mass value="0.6"/>', '<mass value="-0.6"/>'), ["link2", "mass", "negative", "-0.6"]),
        (replaced('<mass value="0.6"/>', '<mass value="0"/>'), ["link2", "mass"]),
        (replaced('iyy="0.00316"', 'iyy="-1"'), ["link2", "inertia", "negative"]),
        (replaced('iyy="0.00316"', 'iyy=""'), ["link2", "inertia"]),
        (replaced('iyy="0.00316"', 'iyy="x"'), ["link2", "inertia", "'x'"]),
        (TEXT.replace(LINK2, '<link name="link2"/>'), ["link2", "<inertial>"]),
        (replaced('lower="-2.6"', 'lower="3"'), ["joint2", "lower", "upper"]),
        (replaced('type="continuous"', 'type="revolute"'), ["joint1", "lower", "upper"]),
        (replaced('<limit velocity="2.5" effort="5.0"/>', ""), ["joint1", "<limit>"]),
        (replaced('effort="3.0"', 'effort="0"'), ["joint2", "effort"]),
        (replaced('effort="3.0"', ""), ["joint2", "limit", "effort"]),
        (replaced('velocity="2.5"', 'velocity="fast"', 'name="joint2"'), ["joint2", "velocity", "fast"]),
        (
            replaced('<joint name="joint2" type="revolute">', '<joint name="joint2" type="prismatic">'),
            ["joint2"],
        ),
        (replaced('type="fixed"', 'type="floating"'), ["tool_mount", "floating", "make it fixed"]),
        (replaced('<origin xyz="0.30 0 0"/>', '<origin xyz="0.30 0"/>'), ["joint2", "origin"]),
        (replaced('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', 'name="joint2"'), ["joint2", "axis"]),
        (replaced('<link name="tool">', '<link name="link2">'), ["link2"]),
        (replaced('<parent link="link1"/>', '<parent link="tool"/>'), ["loop"]),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, list) else "",
)
def test_a_broken_urdf_is_refused_in_one_line_that_names_the_culprit(path, text, words):
    path.write_text(text)
    message = message_of(path)
    for word in [str(path), *words]:
        assert word in message


def test_a_joint_that_the_urdf_lacks_gets_the_nearest_name():
    assert "'joint22'; did you mean 'joint2'?" in message_of(CONFIG.urdf, joints=["joint1", "joint22"])


def test_an_end_effector_that_the_urdf_lacks_gets_the_nearest_name():
    assert "'tol'; did you mean 'tool'?" in message_of(CONFIG.urdf, end_effector="tol")


def test_joints_out_of_order_twice_or_without_a_home_are_refused():
    assert "order" in message_of(CONFIG.urdf, joints=["joint2", "joint1"])
    assert "twice" in message_of(CONFIG.urdf, joints=["joint1", "joint1"])
    assert "home" in message_of(CONFIG.urdf, home=[0.0])
    three = {"joints": ["joint1", "joint2", "tool_mount"], "home": [0.0] * 3, "command_limit": [1.0] * 3}
    assert "tool_mount" in message_of(CONFIG.urdf, **three)


def spec_or_user_error(folder: Path, data: bytes) -> None:
    path = folder / "arm.urdf"
    path.write_bytes(data)
    try:
        spec = spec_of(path)
    except UserError as error:
        assert len(str(error).splitlines()) == 1  # noqa: PT017
    else:
        assert isinstance(spec, RobotSpec)
        assert np.isfinite(spec.link_mass).all()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("urdf")


@settings(max_examples=150, deadline=None)
@given(end=st.integers(0, len(TEXT)), closed=st.booleans())
def test_a_truncated_urdf_is_a_spec_or_a_user_error(folder, end, closed):
    text = TEXT[:end]
    if closed and "<robot" in text:  # what is open is closed again: well-formed, but parts are missing
        text = text[: text.rindex(">") + 1]
        text += "".join(f"</{tag}>" for tag in reversed(open_tags(text)))
    spec_or_user_error(folder, text.encode())


def open_tags(text: str) -> list[str]:
    stack: list[str] = []
    for closing, tag, empty in re.findall(r"<(/?)(\w+)[^<>]*?(/?)>", re.sub(r"<!--.*?-->", "", text, flags=re.S)):
        if closing:
            stack.pop()
        elif not empty:
            stack.append(tag)
    return stack


JUNK = ["", " ", "0", "-1", "1e400", "nan", "x", "0 0", "0 0 0 0", "ä", "\x00", "joint1", "base", "tool"]
NAMES_AND_VALUES = [match.span(1) for match in re.finditer(r'"([^"]*)"', TEXT)]
LINES = TEXT.splitlines(keepends=True)


@settings(max_examples=150, deadline=None)
@given(places=st.lists(st.sampled_from(NAMES_AND_VALUES), min_size=1, max_size=2), junk=st.sampled_from(JUNK))
@example(places=[NAMES_AND_VALUES[0]], junk="")
def test_a_urdf_with_junk_in_an_attribute_is_a_spec_or_a_user_error(folder, places, junk):
    text = TEXT
    for start, end in sorted(set(places), reverse=True):
        text = text[:start] + junk + text[end:]
    spec_or_user_error(folder, text.encode())


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32), drop=st.integers(1, 3))
def test_a_urdf_without_some_of_its_lines_is_a_spec_or_a_user_error(folder, seed, drop):
    gone = set(random.Random(seed).sample(range(len(LINES)), drop))
    spec_or_user_error(folder, "".join(line for index, line in enumerate(LINES) if index not in gone).encode())


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=200), at=st.integers(0, len(TEXT)))
def test_a_urdf_with_random_bytes_in_it_is_a_spec_or_a_user_error(folder, data, at):
    spec_or_user_error(folder, TEXT[:at].encode() + data + TEXT[at:].encode())
