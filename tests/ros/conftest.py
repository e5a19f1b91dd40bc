"""Real ROS 2 for tests: loopback only, a domain for each test, and nothing left behind."""

import gc
import os
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from _pytest.runner import runtestprotocol

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # before anything of ROS starts

from physai.ros.node.run import prepare_middleware

prepare_middleware()

from tests.forge import close_forge
from tests.ros.forge import ForgedProcess
from tests.ros.loop import Loop, closed_loop
from tests.ros.peer import SHM, Peer, Process, free_domain, node_command, remove_dead_segments
from tests.ros.stalls import Stalls

ATTEMPTS = 3
# What fails once in five hundred tests is no news of a node, on a machine that others share; more of it is.
UNEXPLAINED = 3
STALLS = pytest.StashKey[Stalls]()
REPEATED = pytest.StashKey[list[str]]()
EXCUSES = pytest.StashKey[int]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[REPEATED] = []
    config.stash[EXCUSES] = UNEXPLAINED


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Repeat a test that failed while the machine stood still: how soon a node answers says nothing of it then.

    A few of a session are repeated once without such an excuse: a core that others use for 10 ms, again and again,
    is not seen to stand still. All that is repeated is named at the end.
    """
    if not item.path.is_relative_to(Path(__file__).parent):
        return None
    if STALLS not in item.config.stash:
        item.config.stash[STALLS] = Stalls()
        item.config.add_cleanup(item.config.stash[STALLS].close)
    for attempt in range(1, ATTEMPTS + 1):
        began = time.monotonic()
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        if attempt == ATTEMPTS or not any(report.failed for report in reports):
            break
        stall = item.config.stash[STALLS].longest(since=began)
        if stall == 0.0:
            if attempt > 1 or item.config.stash[EXCUSES] == 0:
                break
            item.config.stash[EXCUSES] -= 1
        crash = next(getattr(report.longrepr, "reprcrash", report.longrepr) for report in reports if report.failed)
        reason = textwrap.indent(str(getattr(crash, "message", crash)), "    ")
        excuse = f"a stall of {stall:.2f} s" if stall else "NO stall was seen"
        item.config.stash[REPEATED].append(f"{item.nodeid}: {excuse}\n{reason}")
        item._initrequest()  # fixtures of its own
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_sessionfinish(session: pytest.Session) -> None:
    if hasattr(session.config, "workeroutput"):  # a worker of xdist tells the process that tells the user
        session.config.workeroutput["repeated"] = session.config.stash[REPEATED]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: Any) -> None:
    node.config.stash[REPEATED].extend(getattr(node, "workeroutput", {}).get("repeated", []))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.stash[REPEATED]:
        terminalreporter.section("repeated, for they failed at first")
        for repeated in config.stash[REPEATED]:
            terminalreporter.line(repeated)


@pytest.fixture(autouse=True)
def _garbage_is_left_lying() -> Iterator[None]:
    """To look for it in this process takes 0.3 s, and a robot that lives here would be silent for as long."""
    gc.disable()
    yield
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _no_shared_memory_left() -> Iterator[None]:
    """Nodes that are killed, as many here are, leave segments behind; LTTng leaves its own after everyone."""
    traced = set(SHM.glob("lttng-ust-wait*"))
    yield
    close_forge()  # before their segments are looked for
    remove_dead_segments()
    for path in set(SHM.glob("lttng-ust-wait*")) - traced:
        path.unlink(missing_ok=True)


@pytest.fixture
def domain() -> Iterator[int]:
    """A ROS domain of this test's own."""
    with free_domain() as found:
        yield found


@pytest.fixture
def start(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Process]]:
    """Start nodes of physai: ``start("virtual_robot", rate_hz=100)``; they are gone after the test.

    They are forged, which is quick, and so are commands: ``start.command("ros.demo", "goals=2")``; ``start.run`` runs
    a command line in a Python of its own, as a user does.
    """
    processes: list[Process] = []
    state = tmp_path_factory.mktemp("state")  # no other test's emergency stop
    own = {"XDG_STATE_HOME": str(state)}

    def start(module: str, *args: str, **parameters: Any) -> Process:
        arguments = node_command(module, *args, **parameters)[3:]  # of which one may be called output
        processes.append(ForgedProcess(f"physai.ros.{module}", arguments, domain, state))
        return processes[-1]

    def command(module: str, *arguments: str) -> Process:
        processes.append(ForgedProcess(f"physai.{module}", arguments, domain, state, imported=False))
        return processes[-1]

    def run(command: Sequence[str], env: dict[str, str] | None = None) -> Process:
        processes.append(Process(command, domain, own | (env or {})))
        return processes[-1]

    start.command, start.run = command, run
    yield start
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda process: process.end(), processes))


@pytest.fixture
def start_robot(start: Callable[..., Process]) -> Callable[..., Process]:
    """Start a virtual robot and wait until it is there: who connects to one looks for it for some seconds only."""

    def start_robot(*args: str, **parameters: Any) -> Process:
        robot = start("virtual_robot", *args, **parameters)
        robot.says("takes joint_velocity", 60.0)
        return robot

    return start_robot


@pytest.fixture
def peer(domain: int) -> Iterator[Peer]:
    """A node in this process that listens to everything."""
    made = Peer(domain)
    yield made
    made.close()


@pytest.fixture(scope="session")
def policy_path(exported_run: Path) -> Path:
    return exported_run / "policy.pt"


@pytest.fixture(scope="module")
def loop(policy_path: Path) -> Iterator[Loop]:
    """The inference node and an arm, shared by the tests of a module; each begins with ``loop.start()`` or the like."""
    with closed_loop(policy_path) as made:
        yield made
