"""The page of ``python -m physai.train render=web``: the episodes of each evaluation, as soon as they are over.

It lives in a process of its own, which takes only the time that training leaves over.
"""

import multiprocessing
import os
import queue
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import viser

from physai.envs.simulation import EnvConfig, Simulation
from physai.errors import UserError
from physai.processes import follow
from physai.training.evaluation import WATCHED, Recording
from physai.web.appearance import Appearance
from physai.web.goal import GoalMarker
from physai.web.scene import RobotScene, on_the_spot
from physai.web.server import serve

_COLUMNS = 4
_APART = 2.3  # lengths of a stretched arm, between two bases
_FRAMES = 20.0  # pictures a second
_HOLD = 1.5  # s, at the end of the episodes, before they are shown again
_PATIENCE = 60.0  # s, for the process to start


class TrainingPage:
    """A page in another process; what is shown there is handed over, and never waited for.

    Args:
        config: The robots.
        host: An address of this computer.
        port: Where to listen; 0 takes a free one.

    Attributes:
        address: Of the page.

    Raises:
        UserError: If it cannot listen there, or the robot cannot be drawn.
    """

    def __init__(self, config: EnvConfig, host: str, port: int) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would take the engines and threads of training along
        self._episodes: Any = context.Queue()
        here, there = context.Pipe(duplex=False)
        arguments = (os.getpid(), config, host, port, there, self._episodes)
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        self._process.start()
        there.close()
        try:
            said = here.recv() if here.poll(_PATIENCE) else UserError("the page has not started")
        except EOFError:
            said = UserError("the page has ended before it began")
        if isinstance(said, UserError):
            self.close()
            raise said
        self.address = said

    def show(self, frames: int, recording: Recording) -> None:
        """Show the episodes of a policy that has learned from so many frames."""
        if self._process.is_alive():  # else nobody looks, and training goes on
            self._episodes.put((frames, recording))

    def close(self) -> None:
        """End the page; may be called twice."""
        self._episodes.cancel_join_thread()
        self._process.kill()
        self._process.join()


def _serve(
    parent: int, config: EnvConfig, host: str, port: int, ready: Connection, episodes: "queue.Queue[Any]"
) -> None:
    follow(parent)
    os.nice(19)
    try:
        simulation = Simulation(config, 1, 0)
        simulation.close()
        look = Appearance.of_robot(simulation.spec)
        with serve(host, port, f"physai: {config.name}", 2.5 * look.reach, look.floor) as server:
            page = _Page(server, simulation, look)
            ready.send(f"http://{host}:{server.get_port()}")
            page.run(episodes)
    except UserError as error:
        ready.send(error)


class _Page:
    """Some robots side by side, which do again and again what they did in the last evaluation."""

    def __init__(self, server: viser.ViserServer, simulation: Simulation, look: Appearance) -> None:
        self._server, self._dt = server, simulation.config.control_dt
        self._words = server.gui.add_markdown("The first evaluation is still to come.")
        task, home = simulation.task, simulation.spec.home
        self._robots, self._goals = [], []
        for number in range(WATCHED):
            row, column = divmod(number, _COLUMNS)
            place = np.array([row - 0.5, column - (_COLUMNS - 1) / 2, 0.0]) * _APART * look.reach
            robot = RobotScene(server, f"robot{number + 1}", look, tuple(place))
            robot.show(home)
            self._robots.append(robot)
            self._goals.append(GoalMarker(robot, server, task.goal, task.tolerances, None, home))

    def run(self, episodes: "queue.Queue[Any]") -> None:
        """Show what comes, until the process is ended."""
        recording: Recording | None = None
        began = 0.0
        while True:
            try:
                frames, recording = episodes.get(timeout=1.0 / _FRAMES)
            except queue.Empty:
                pass
            else:
                began = time.monotonic()
                self._begin(frames, recording)
            if recording is None:
                continue
            step = int((time.monotonic() - began) / self._dt)
            last = len(recording.joint_position) - 1
            if step > last + _HOLD / self._dt:
                began, step = time.monotonic(), 0
            if self._server.get_clients():
                self._show(recording, min(step, last))

    def _begin(self, frames: int, recording: Recording) -> None:
        for marker, goal in zip(self._goals, recording.goal, strict=False):
            marker.show(goal)
        successes = f"{recording.success.sum()} of these {len(recording.success)} episodes succeed."
        self._words.content = f"After **{frames:,}** frames: **{successes}**"
        self._show(recording, 0)

    def _show(self, recording: Recording, step: int) -> None:
        with self._server.atomic():
            for robot, position in zip(self._robots, recording.joint_position[step], strict=False):
                robot.show(position)
            if recording.base_pose is not None:
                for robot, pose in zip(self._robots, recording.base_pose[step], strict=False):
                    robot.move_base(on_the_spot(pose))
