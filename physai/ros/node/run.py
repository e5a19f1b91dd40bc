"""How a node of physai starts, and how it ends: whatever happens, ``finish`` is called while ROS still works."""

import argparse
import gc
import os
import re
import signal
import sys
import threading
import traceback
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from typing import Any, Generic

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger

from physai.deploy.parameters import Parameters
from physai.errors import UserError
from physai.ros.node import signals
from physai.ros.node.executor import Executor
from physai.ros.node.outlet import outlets
from physai.ros.node.parameters import P, declare, help_text

# Jazzy's Fast DDS (2.14) reads the first, later ones the second.
_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
_LAST_DOMAIN = 232  # that has numbers for its ports
# ROS' log files: a disk that stands still would stop the node in the middle of a line. What the user says comes later.
_NO_LOG_FILES = ["--ros-args", "--disable-external-lib-logs", "--"]


class StoppableNode(Node, Generic[P]):
    """A node that has parameters, answers, does something periodically, and knows how to end.

    Args:
        name: Of the node.
        kind: Its parameters.
        arguments: ROS arguments of this node alone; None takes those of the command line.

    Attributes:
        config: The values of the parameters, as they are now.
        stopped: Set it to end the program.
        code: The exit code.

    Raises:
        UserError: If a parameter is wrong.
    """

    stopped, code = False, 0

    def __init__(self, name: str, kind: type[P], arguments: list[str] | None = None) -> None:
        super().__init__(name, cli_args=arguments, use_global_arguments=arguments is None)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.config = declare(self, kind, self._change)

    def _change(self, config: P) -> None:
        self.configure(config)
        self.config = config

    def configure(self, config: P) -> None:
        """Take other values while the node runs; may raise a UserError, and then must change nothing."""

    def every(self, period: float, work: Callable[[], None]) -> None:
        """Call something once a period, s; neither a paused simulation nor a change of the time of day stops it."""
        self.create_timer(period, work, clock=self._steady)

    def offer(self, service: str, act: Callable[[], tuple[bool, str]]) -> None:
        """Offer a std_srvs/Trigger service: what it does returns whether it could, and a message."""

        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success, response.message = act()
            return response

        self.create_service(Trigger, service, answer)

    @abstractmethod
    def finish(self) -> None:
        """Leave the robot standing, or the file complete; no callback comes after it."""


def run(make_node: Callable[[], StoppableNode[P]], module: str, about: str, kind: type[Parameters]) -> int:
    """Run a node until a signal, its own wish or an exception ends it.

    ROS' own signal handlers close the context before anything can be published; ours only end the loop.

    Args:
        make_node: Called when ROS is up.
        module: What ``python -m`` runs, for the help text.
        about: What the node does, for the help text.
        kind: Its parameters, for the help text.

    Returns:
        The exit code: 0 after a signal or by its own wish (or what the node says), 1 after an exception, 2 if the
        user's input was wrong.
    """
    caught = signals.catch()
    parser = argparse.ArgumentParser(
        prog=f"python -m {module}",
        usage="%(prog)s --ros-args [-p name:=value] [--params-file file.yaml] [-r topic:=/other/topic]",
        description=f"{about}\n\nParameters, with their defaults:\n{help_text(kind)}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    try:
        parser.parse_args(remove_ros_args(sys.argv)[1:])
    except RuntimeError as error:  # RCLError: such as a file of parameters that does not exist
        return _refuse(brief(error))
    return _run({"": make_node}, sys.argv[1:], caught)


def run_together(make_nodes: Mapping[str, Callable[[], StoppableNode[Any]]]) -> int:
    """Run nodes that belong together in one process and one thread; when one of them ends, all do.

    Many processes whose turn is short find nothing of theirs in a core's caches.

    Args:
        make_nodes: By namespace; called in this order when ROS is up, each with ROS arguments of its own.

    Returns:
        The exit code, as of :func:`run`.
    """
    return _run(make_nodes, [], signals.catch())


def prepare_middleware() -> None:
    """Have Fast DDS find and miss nodes quickly, and use UDP alone (see fastdds.xml); the user's own settings stay.

    Raises:
        UserError: If ROS_DOMAIN_ID is none.
    """
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not re.fullmatch("0|[1-9][0-9]{0,2}", domain, re.ASCII) or int(domain) > _LAST_DOMAIN:
        raise UserError(f"ROS_DOMAIN_ID: must be a whole number from 0 to {_LAST_DOMAIN}, got {domain!r}")
    if not any(name in os.environ for name in _PROFILES):
        os.environ.update(dict.fromkeys(_PROFILES, str(files("physai.ros") / "fastdds.xml")))
        os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")  # beyond LOCALHOST, where ROS chooses for itself


def _run(
    make_nodes: Mapping[str, Callable[[], StoppableNode[Any]]], arguments: Sequence[str], caught: Mapping[int, object]
) -> int:
    try:
        prepare_middleware()
    except UserError as error:
        return _refuse(str(error))
    with outlets():
        try:
            return _spin(make_nodes, arguments, caught)
        finally:
            gc.collect()  # a node that was refused half made: it must go while ROS still works
            rclpy.try_shutdown()
            signals.ignore()


def _spin(
    make_nodes: Mapping[str, Callable[[], StoppableNode[Any]]], arguments: Sequence[str], caught: Mapping[int, object]
) -> int:
    nodes: list[StoppableNode[Any]] = []
    name = ""
    try:
        told = [*sys.argv[:1], *_NO_LOG_FILES, *arguments]
        rclpy.init(args=told, signal_handler_options=SignalHandlerOptions.NO)
        for name in make_nodes:
            nodes.append(make_nodes[name]())
    except (UserError, ParameterException) as error:  # such as a use_sim_time that is no bool
        return _refuse(f"{name}: {error}" if name else str(error))
    except RuntimeError as error:  # RCLError
        return _refuse(_of_ros(error))
    except Exception:  # said here: nothing can be said any more when this function has returned
        traceback.print_exc()
        return 1
    gc.collect()
    gc.freeze()  # to look for garbage in all that is imported would hold up every command for a tenth of a second

    def ends() -> bool:
        return bool(caught) or any(node.stopped for node in nodes)

    executor = Executor(nodes, ends)
    what = "this node" if len(nodes) == 1 else "this process"
    code, last_words = 0, ""
    try:
        while not ends():
            executor.spin_once(timeout_sec=0.1)
    except UserError as error:
        code, last_words = 2, str(error)
    except Exception as error:
        code, last_words = 1, f"{type(error).__name__} ends {what}: {error}\n{traceback.format_exc()}"
    finally:
        for node in nodes:
            node.code = code or node.code
        _finish(nodes)  # before anything else
    log = nodes[0].get_logger()
    if last_words:
        log.fatal(last_words)
    else:
        log.info(f"{signal.Signals(next(iter(caught))).name} ends {what}" if caught else f"{what} ends")
    executor.shutdown(timeout_sec=1.0)
    for node in nodes:
        node.destroy_node()
    return max(node.code for node in nodes)


def _finish(nodes: Sequence[StoppableNode[Any]]) -> None:
    """Let all of them finish side by side: each waits for those who hear it, and for its disk."""
    others = [threading.Thread(target=node.finish) for node in nodes[1:]]
    for other in others:
        other.start()
    try:
        nodes[0].finish()
    finally:
        for other in others:
            other.join()


def _of_ros(error: Exception) -> str:
    """What ROS says, and what it does not say where its security is on."""
    if os.environ.get("ROS_SECURITY_ENABLE") != "true":
        return brief(error)
    needs = "ROS_SECURITY_KEYSTORE, keys of this node, and a Fast DDS built with security, which PyPI's is not"
    return f"ROS_SECURITY_ENABLE=true needs {needs}: {brief(error)}"


def brief(error: Exception) -> str:
    """What ROS says, without its lines of source code."""
    return str(error).splitlines()[0].split(", at /")[0]


def _refuse(reason: str) -> int:
    print(f"error: {reason}", file=sys.stderr)
    return 2
