"""The page of ``python -m physai.play render=web``: a policy that follows what people drag, or ask for by sliders."""

import contextlib
import queue
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from physai.compose import compose, conf_dir
from physai.config import validate
from physai.errors import UserError
from physai.physics import RandomizationConfig
from physai.physics.randomization import Uniform
from physai.signals import Quantity
from physai.targets import find
from physai.web.appearance import Appearance
from physai.web.driven import DrivenRobot
from physai.web.goal import GoalMarker
from physai.web.scene import RobotScene, on_the_spot
from physai.web.server import CELL, Server, serve

_FRAMES = 30.0  # pictures a second; browsers blend nothing, and more would not be seen
_WORDS = 5.0  # updates of what is written, a second
_LATE = 0.1  # s that a slow computer makes up for; a page that was asleep does not race afterwards
_SLIDERS = {
    "payload": "Payload, kg",
    "actuator_delay": "Delay, control steps",
    "position_noise": "Noise of positions, rad",
    "velocity_noise": "Noise of velocities, rad/s",
}


@dataclass(frozen=True)
class Choices:
    """What a person can choose from on the page.

    Attributes:
        policies: Run folders or policy files; the first is shown at first.
        engines: Files of ``conf/physics``.
        load: Makes the robot of a policy, in an engine or, with None, in its own; raises a UserError.
    """

    policies: Sequence[str]
    engines: Sequence[str]
    load: Callable[[str, str | None], DrivenRobot]


class LivePage:
    """Shows a robot and what it may be asked; all of it happens in the thread that calls ``run``.

    What browsers ask for is put into a queue, which ``run`` empties before each step.

    Args:
        server: Where to show it.
        choices: What there is to choose from.
        robot: That of the first policy; it is closed with the page, as are those that are chosen later.
    """

    def __init__(self, server: Server, choices: Choices, robot: DrivenRobot) -> None:
        self._server, self._choices, self._robot = server, choices, robot
        self._numbers: dict[int, viser.GuiSliderHandle[float]] = {}
        self._told = np.zeros(0)  # the goal that they show
        self._asked: queue.SimpleQueue[Callable[[], Any]] = queue.SimpleQueue()
        self._paused, self._dragging = False, False
        gui = server.gui
        self._policy = gui.add_dropdown("Policy", list(choices.policies))
        self._engine = gui.add_dropdown("Engine", list(choices.engines), initial_value=_engine_of(robot, choices))
        self._policy.on_update(self._when(lambda: self._choose(None)))
        self._engine.on_update(self._when(lambda: self._choose(self._engine.value)))
        self._words = gui.add_markdown("")
        self._pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._pause.on_click(self._when(self._toggle))
        gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT).on_click(self._when(self._one_step))
        gui.add_button("Reset", icon=viser.Icon.RELOAD).on_click(self._when(self._reset))
        gui.add_button("Another goal", icon=viser.Icon.TARGET).on_click(self._when(self._draw_goal))
        self._by_itself = gui.add_checkbox("Goals by themselves", False, hint="Who asks for one turns this off.")
        self._speed = gui.add_slider("Speed, times real time", 0.1, 4.0, 0.1, 1.0)
        self._wanted = gui.add_folder("Asked for", visible=False)
        with gui.add_folder("The robot"):
            self._sliders = self._add_sliders()
        self._show_robot()

    def run(self) -> None:
        """Drive the robot until an exception, such as Ctrl-C, ends it."""
        due = drawn = written = time.monotonic()
        while True:
            while not self._asked.empty():
                self._asked.get()()
            if not self._paused:
                self._step()
            now = time.monotonic()
            if now - drawn >= 1.0 / _FRAMES:
                self._draw()
                drawn = now
            if now - written >= 1.0 / _WORDS:
                self._words.content = self._describe()
                written = now
            due = max(due + self._robot.simulation.config.control_dt / self._speed.value, now - _LATE)
            time.sleep(max(0.0, due - time.monotonic()))

    def close(self) -> None:
        """Free the robot."""
        self._robot.close()

    def _when(self, action: Callable[[], Any]) -> Callable[[viser.GuiEvent], None]:
        def ask(event: viser.GuiEvent) -> None:
            if event.client is not None:  # and not this page, which sets values, too
                self._asked.put(action)

        return ask

    def _add_sliders(self) -> dict[str, viser.GuiSliderHandle[float]]:
        """One for each parameter that robots have, up to what is more than a policy can cope with."""
        widest = validate(RandomizationConfig, compose("train", ["randomization=wide"]).randomization).draws
        sliders = {}
        for name, label in _SLIDERS.items():
            draw = widest.get(name)
            if draw is None or not isinstance(most := getattr(draw, "high", None), float):
                continue
            step = 1.0 if name == "actuator_delay" else most / 100
            sliders[name] = self._server.gui.add_slider(label, 0.0, most, step, 0.0)
            sliders[name].on_update(self._when(lambda name=name: self._change(name)))  # type: ignore[misc]
        return sliders

    def _show_robot(self) -> None:
        """Draw what has been chosen."""
        robot = self._robot
        simulation = robot.simulation
        look = Appearance.of_robot(simulation.spec)
        self._scene = RobotScene(self._server, "robot", look)
        self._server.floor.position = (0.0, 0.0, look.floor)
        task = simulation.task
        self._marker = GoalMarker(
            self._scene, self._server, task.goal, task.tolerances, task.region, simulation.spec.home, self._drag
        )
        for name, slider in self._sliders.items():
            _set(slider, float(robot.parameters[simulation.layout.columns[name]][0]))
        self._add_numbers()
        self._draw()
        self._words.content = self._describe()

    def _add_numbers(self) -> None:
        """A slider for each number of a goal that is no place, and so cannot be dragged."""
        for slider in self._numbers.values():
            slider.remove()
        self._numbers.clear()
        self._told = np.zeros(0)
        goal = self._robot.simulation.task.goal
        self._wanted.visible = not self._marker.drawable and bool(np.isfinite(goal.bounds).all())
        if not self._wanted.visible:
            return
        with self._wanted:
            labels = goal.labels or tuple(f"number {number}" for number in range(1, goal.size + 1))
            for number, (label, low, high) in enumerate(zip(labels, *goal.bounds, strict=True)):
                if low < high:
                    step, name = (high - low) / 100, label.replace("_", " ")
                    slider = self._server.gui.add_slider(name, low, high, step, np.clip(0.0, low, high).item())
                    slider.on_update(self._asking(number))
                    self._numbers[number] = slider

    def _asking(self, number: int) -> Callable[[viser.GuiEvent], None]:
        def ask(event: viser.GuiEvent) -> None:
            if event.client is not None:
                value = float(event.target.value)  # as it is now: the next one may already be on its way
                self._asked.put(lambda: self._ask_for(number, value))

        return ask

    def _ask_for(self, number: int, value: float) -> None:
        if number in self._numbers:
            goal = self._robot.goal.copy()
            goal[number] = value
            self._told = goal  # and is not told again, unless another one is taken
            self._aim(goal, True)

    def _choose(self, engine: str | None) -> None:
        """Take another policy, or another engine; what cannot be loaded changes nothing, and says why."""
        try:
            robot = self._choices.load(self._policy.value, engine)
        except UserError as error:
            for client in self._server.get_clients().values():
                client.add_notification("This cannot be shown", str(error), color="red")
            return
        self._robot.close()
        self._scene.remove()
        self._robot, self._dragging = robot, False
        _set(self._engine, _engine_of(robot, self._choices) or self._choices.engines[0])
        self._show_robot()

    def _drag(self, goal: np.ndarray, released: bool) -> None:
        """Called by the server's thread."""
        self._asked.put(lambda: self._aim(goal, released))

    def _aim(self, goal: np.ndarray, released: bool) -> None:
        if goal.shape != self._robot.goal.shape:  # of a robot that is not shown any more
            return
        _set(self._by_itself, False)
        self._dragging = not released
        self._robot.aim(goal, released)
        self._draw()

    def _change(self, name: str) -> None:
        self._robot.set_parameter(name, float(self._sliders[name].value))

    def _toggle(self) -> None:
        self._paused = not self._paused
        self._pause.label = "Go on" if self._paused else "Pause"

    def _one_step(self) -> None:
        self._paused, self._pause.label = True, "Go on"
        self._step()

    def _reset(self) -> None:
        self._robot.clear()
        self._draw()

    def _draw_goal(self) -> None:
        self._robot.draw_goal()
        self._draw()

    def _step(self) -> None:
        self._robot.step()
        if self._by_itself.value and self._robot.finished:
            self._robot.draw_goal()

    def _draw(self) -> None:
        self._scene.show(self._robot.joint_position)
        if (pose := self._robot.base_pose) is not None:  # it walks on the spot, and the floor moves below it
            self._scene.move_base(on_the_spot(pose))
            self._server.floor.position = (*-np.fmod(pose[:2], CELL), self._scene.appearance.floor)
        if not self._dragging:  # else the browser knows better where it is
            self._marker.show(self._robot.goal)
        if not np.array_equal(self._robot.goal, self._told):  # else the sliders know better
            self._told = self._robot.goal.copy()
            for number, slider in self._numbers.items():
                _set(slider, round(float(self._told[number]), 3))

    def _describe(self) -> str:
        robot = self._robot
        task, error = robot.simulation.task, robot.simulation.error[0]
        walks = task.goal.quantity is Quantity.TWIST
        lines = [
            f"{tolerance.name.replace('_', ' ').capitalize()} {'off by' if walks else 'to the goal'}: "
            f"**{value:.3f} {tolerance.unit}**"
            for tolerance, value in zip(task.tolerances, error, strict=True)
        ]
        if (twist := robot.simulation.state.base_twist) is not None:
            lines.insert(
                0, f"It walks at **{np.hypot(*twist[0, :2]):.2f} m/s**, and turns at **{twist[0, 5]:.2f} rad/s**"
            )
        if walks:
            return "  \n".join([*lines, f"Falls: **{robot.crashed}**"])
        lines.append(f"Goals: **{robot.goals}**, reached: **{robot.reached}**, settled: **{robot.settled}**")
        if robot.crashed:
            lines.append(f"Collisions: **{robot.crashed}**")
        return "  \n".join(lines)


def serve_page(choices: Choices, robot: DrivenRobot, host: str, port: int) -> None:
    """Serve the page, and say where, until an exception, such as Ctrl-C, ends it.

    Args:
        choices: What there is to choose from.
        robot: That of the first policy; it is closed at the end.
        host: An address of this computer.
        port: Where to listen; 0 takes a free one.
    """
    with ExitStack() as stack:
        stack.callback(lambda: robot.close())
        look = Appearance.of_robot(robot.simulation.spec)
        server = stack.enter_context(serve(host, port, "physai", look.reach, look.floor))
        page = stack.enter_context(closing(LivePage(server, choices, robot)))
        print(f"The page: http://{host}:{server.get_port()} (Ctrl-C ends it)", flush=True)
        page.run()


def engines() -> list[str]:
    """Files of ``conf/physics`` that can simulate robots here."""
    found = []
    for name in sorted(path.stem for path in (conf_dir() / "physics").glob("*.yaml")):
        with contextlib.suppress(UserError, ValueError):  # what is not installed
            if find(engine(name)["_target_"]).simulated:
                found.append(name)
    return found


def engine(name: str) -> dict[str, Any]:
    """What a file of ``conf/physics`` holds, as an env takes it."""
    return dict(compose("train", [f"physics={name}"]).physics)


def sensed(randomization: RandomizationConfig) -> RandomizationConfig:
    """The same robots, with sensors whose noise can be changed later: one of zero where they have none."""
    silent = Uniform(distribution="uniform", low=0.0, high=0.0, operation="set")
    names = ("position_noise", "velocity_noise")
    return randomization.model_copy(update={name: silent for name in names if getattr(randomization, name) is None})


def _set(handle: Any, value: object) -> None:
    """Set what a browser shows and may set itself; viser's types know it only as something to read."""
    if handle.value != value:
        handle.value = value


def _engine_of(robot: DrivenRobot, choices: Choices) -> str | None:
    """The file of ``conf/physics`` that a robot runs in."""
    target = robot.simulation.config.physics["_target_"]
    return next((name for name in choices.engines if engine(name)["_target_"] == target), None)
