"""How a node of physai starts, and how it ends: whatever happens, ``finish`` is called while ROS still works."""

import argparse
import contextlib
import os
import signal
import sys
import traceback
from abc import abstractmethod
from collections.abc import Callable, Iterator
from importlib.resources import files

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from physai.deploy.parameters import Parameters
from physai.errors import UserError
from physai.ros.parameters import help_text

_SIGNALS = (
    signal.SIGINT,
    signal.SIGTERM,
    signal.SIGHUP,
    signal.SIGQUIT,
    signal.SIGUSR1,
    signal.SIGUSR2,
    signal.SIGALRM,
)
# Jazzy's Fast DDS (2.14) reads the first, later ones the second.
_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")


class StoppableNode(Node):
    """A node that knows how to end.

    Attributes:
        stopped: Set it to end the program.
    """

    stopped = False

    @abstractmethod
    def finish(self) -> None:
        """Leave the robot standing, or the file complete; no callback comes after it."""


def run(make_node: Callable[[], StoppableNode], module: str, about: str, kind: type[Parameters]) -> int:
    """Run a node until a signal, its own wish or an exception ends it.

    ROS' own signal handlers close the context before anything can be published; ours only end the loop.

    Args:
        make_node: Called when ROS is up.
        module: What ``python -m`` runs, for the help text.
        about: What the node does, for the help text.
        kind: Its parameters, for the help text.

    Returns:
        The exit code: 0 after a signal or by its own wish, 1 after an exception, 2 if the user's input was wrong.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m {module}",
        usage="%(prog)s --ros-args [-p name:=value] [--params-file file.yaml] [-r topic:=/other/topic]",
        description=f"{about}\n\nParameters, with their defaults:\n{help_text(kind)}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    try:
        arguments = remove_ros_args(sys.argv)[1:]
    except RuntimeError as error:  # RCLError: such as a file of parameters that does not exist
        return _refuse(brief(error))
    parser.parse_args(arguments)
    prepare_middleware()
    with _signals() as caught:
        try:
            rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:  # RCLError
            return _refuse(brief(error))
        try:
            return _run(make_node, caught)
        finally:
            rclpy.try_shutdown()


def prepare_middleware() -> None:
    """Have Fast DDS find and miss nodes quickly, and use UDP alone (see fastdds.xml); the user's own settings stay."""
    if not any(name in os.environ for name in _PROFILES):
        os.environ.update(dict.fromkeys(_PROFILES, str(files("physai.ros") / "fastdds.xml")))
        os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")  # beyond LOCALHOST, where ROS chooses for itself


def _run(make_node: Callable[[], StoppableNode], caught: list[int]) -> int:
    try:
        node = make_node()
    except (UserError, ParameterException) as error:  # such as a use_sim_time that is no bool
        return _refuse(str(error))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    log = node.get_logger()
    try:
        while not node.stopped and not caught:
            executor.spin_once(timeout_sec=0.1)
        log.info(f"{signal.Signals(caught[0]).name} ends this node" if caught else "this node ends")
        return 0
    except UserError as error:
        log.fatal(str(error))
        return 2
    except Exception as error:
        log.fatal(f"{type(error).__name__} ends this node: {error}\n{traceback.format_exc()}")
        return 1
    finally:
        try:
            executor.shutdown(timeout_sec=1.0)
        finally:
            node.finish()
            node.destroy_node()


@contextlib.contextmanager
def _signals() -> Iterator[list[int]]:
    """Note signals instead of dying of them."""
    caught: list[int] = []
    before = {number: signal.signal(number, lambda number, _: caught.append(number)) for number in _SIGNALS}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def brief(error: Exception) -> str:
    """What ROS says, without its lines of source code."""
    return str(error).splitlines()[0].split(", at /")[0]


def _refuse(reason: str) -> int:
    print(f"error: {reason}", file=sys.stderr)
    return 2
