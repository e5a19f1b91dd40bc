"""What the tests of deployment share: the real policy, its file, and an arm under a controller."""

from pathlib import Path

import pytest

from physai.deploy import Policy, load_policy

for helper in ("files", "hearing", "legs", "robot", "targets", "world"):
    pytest.register_assert_rewrite(f"tests.deploy.{helper}")


@pytest.fixture(scope="session")
def policy(exported_run) -> Policy:
    """The real policy of a two-link arm: loaded once, not to be changed."""
    return load_policy(exported_run / "policy.pt")


@pytest.fixture(scope="session")
def position_policy(position_run) -> Policy:
    """The same, of an arm that is driven by positions."""
    return load_policy(position_run / "policy.pt")


@pytest.fixture(scope="session")
def content(exported_run) -> bytes:
    return (exported_run / "policy.pt").read_bytes()


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "policy.pt"


@pytest.fixture
def robot(policy):
    """An arm that stays where it is put."""
    from tests.deploy.robot import Robot

    return Robot(policy)


@pytest.fixture
def moving(robot):
    """The same, at full speed."""
    robot.drive()
    return robot
