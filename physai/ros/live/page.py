"""The dashboard's page: robots side by side, what each of them tells, and what people may ask of them."""

import html
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Iterable
from functools import partial
from typing import Any

import numpy as np
import viser

from physai.ros.live.arm_view import ArmView
from physai.ros.live.robots import Ask, Robots
from physai.ros.live.status import Level, Status, stop_words
from physai.web.door import Door, Visitor, commander

_FRAMES = 15.0  # pictures a second
_STATES, _WORDS, _PATHS, _SAMPLES, _PLOTS = 0.1, 0.3, 0.5, 0.5, 2.0  # s between two updates
_MINUTES = 3
_ASLEEP = 0.5  # s without a picture: then this program stood still, and what has waited for it is old
_DEAF = 1.0  # s after that, in which what has waited arrives
_APART = 2.2  # lengths of the longest stretched arm, between two bases
_NOTICE = """<p style="margin:0.6em 1em;font-size:0.8em;opacity:0.8">This page is a convenience, and holds no safety:
it may be late, or wrong, or gone. When it goes, nothing changes on any robot. The button that cuts the power is
elsewhere.</p>"""
# Over the picture, where it neither scrolls away nor is covered; viser notifies above.
# The element after the one of this class is the button.
_STOP = """<style>
div:has(> .physai-stop) + div { position: fixed; bottom: 1.5em; left: 1.5em; z-index: 100000; margin: 0; padding: 0; }
div:has(> .physai-stop) + div button { width: 13em !important; height: 4em !important; font-size: 1.6em !important;
  font-weight: 800; box-shadow: 0 0 0 4px white, 0 2px 12px black; }
</style><span class="physai-stop"></span>"""


class Page:
    """Shows what robots tell, again and again, in the thread that calls ``run``; nothing waits for a browser.

    Args:
        server: Where to show it.
        door: Who may command.
        robots: What is shown, and asked.
    """

    def __init__(self, server: viser.ViserServer, door: Door, robots: Robots) -> None:
        self._server, self._robots = server, robots
        self._commands = door.commands
        self._cards: dict[str, _Card] = {}
        self._arms: dict[str, ArmView] = {}
        self._bad: dict[str, tuple[str, str]] = {}  # why a robot with this description cannot be drawn
        self._drags: dict[str, tuple[Visitor, np.ndarray]] = {}
        self._frame = time.monotonic()
        self._deaf_until = -math.inf
        gui = server.gui
        if door.commands:
            gui.add_html(_STOP)
            stop = gui.add_button("STOP ALL", color="red", icon=viser.Icon.HAND_STOP)
            stop.on_click(self._when(lambda: Ask("stop all")))
        self._summary = gui.add_html("")
        self._tabs = gui.add_tab_group()
        gui.add_html(_NOTICE if door.commands else f"{_NOTICE}<p style='margin:0.6em 1em'>It only watches.</p>")

    def run(self, ended: threading.Event) -> None:
        """Show what there is until it shall end."""
        tasks: list[tuple[float, Callable[[list[Status], float], None]]] = [
            (_STATES, self._write_states),
            (_WORDS, self._write_cards),
            (_SAMPLES, self._sample),
            (_PATHS, self._draw_paths),
            (_PLOTS, self._plot),
        ]
        last = dict.fromkeys(range(len(tasks)), -math.inf)
        while not ended.wait(1.0 / _FRAMES):
            now = time.monotonic()
            self._wake(now)
            robots = self._robots.all
            self._arrange(robots)
            for robot in robots:
                if (arm := self._arms.get(robot.namespace)) is not None:
                    arm.show(robot, robot.headline(now)[0], robot.namespace in self._drags, now)
            for number, (period, work) in enumerate(tasks):
                if now - last[number] >= period:
                    last[number] = now
                    work(robots, now)

    def _wake(self, now: float) -> None:
        if now - self._frame > _ASLEEP:
            self._deaf_until = now + _DEAF
        self._frame = now

    # What people want

    def _when(self, wanted: Callable[[], Ask]) -> Callable[[viser.GuiEvent], Coroutine[Any, Any, None]]:
        async def ask(event: viser.GuiEvent) -> None:
            """A coroutine, which viser runs where the connection is known."""
            refusal = self._ask(wanted())
            if refusal and event.client is not None:
                event.client.add_notification("Not done", refusal, color="red", auto_close_seconds=8.0)

        return ask

    def _ask(self, wanted: Ask) -> str | None:
        """Pass it on, or return why not."""
        if commander() is None:
            return "This browser may only watch: open the address with the token."
        now = time.monotonic()
        if not wanted.stops and (now < self._deaf_until or now - self._frame > _ASLEEP):
            return "The page stood still, and does not do what was asked meanwhile. Ask again."
        self._robots.ask(wanted)
        return None

    def _drag(self, namespace: str, goal: np.ndarray, released: bool) -> None:
        """Remember what who may command drags, and send it once they let go; what others drag jumps back.

        Only what they have dragged themselves: viser's own position of the goal may be anybody's.
        """
        visitor, held = commander(), self._drags.get(namespace)
        if visitor is None:
            if held is not None and held[0].gone:
                del self._drags[namespace]
        elif not released:
            self._drags[namespace] = visitor, goal
        elif held is not None and held[0] is visitor:
            del self._drags[namespace]
            self._ask(Ask("goal", namespace, held[1]))

    # What they see

    def _arrange(self, robots: Iterable[Status]) -> None:
        """Have a card and an arm of each robot, and none of those that are forgotten."""
        before = {name: arm.reach for name, arm in self._arms.items()}
        known = set()
        for robot in robots:
            name = robot.namespace
            known.add(name)
            if name not in self._cards:
                self._cards[name] = _Card(self._server, self._tabs, robot.name, self._buttons(name))
            told = robot.description, robot.goal_description
            arm = self._arms.get(name)
            if robot.description and self._bad.get(name) != told and (arm is None or arm.descriptions != told):
                self._draw_anew(robot)
        for name in [name for name in self._cards if name not in known]:
            self._cards.pop(name).remove()
            if (arm := self._arms.pop(name, None)) is not None:
                arm.remove()
            self._bad.pop(name, None)
        if before != {name: arm.reach for name, arm in self._arms.items()}:
            self._place()

    def _draw_anew(self, robot: Status) -> None:
        name = robot.namespace
        if (old := self._arms.pop(name, None)) is not None:
            old.remove()
        drag = partial(self._drag, name) if self._commands else None
        try:
            self._arms[name] = ArmView(self._server, robot, drag)
            self._bad.pop(name, None)
        except Exception as error:  # whatever a description of anybody makes of what draws it: the page goes on
            self._bad[name] = robot.description, robot.goal_description
            self._cards[name].problem = f"it cannot be drawn: {error}"
        else:
            self._cards[name].problem = self._arms[name].problem

    def _place(self) -> None:
        """Put them side by side: nobody knows where they stand towards each other."""
        longest = max((arm.reach for arm in self._arms.values()), default=1.0)
        columns = max(1, math.ceil(math.sqrt(len(self._arms))))
        rows = math.ceil(len(self._arms) / columns)
        step = _APART * longest
        for number, (_, arm) in enumerate(sorted(self._arms.items())):
            row, column = divmod(number, columns)
            arm.place(((column - (columns - 1) / 2) * step, ((rows - 1) / 2 - row) * step, 0.0))
        extent = longest * (1 + _APART * (max(columns, rows) - 1) / 2)
        self._server.initial_camera.position = (0.0, -0.9 * extent, 1.1 * extent)
        self._server.initial_camera.look_at = (0.0, 0.0, 0.0)

    def _buttons(self, namespace: str) -> Callable[[], None]:
        def add() -> None:
            gui = self._server.gui
            for label, what, color in (("Stop", "stop", "red"), ("Enable", "enable", None), ("Reset", "reset", None)):
                button = gui.add_button(f"{label} {namespace.strip('/') or 'robot'}", color=color)  # type: ignore[arg-type]
                button.on_click(self._when(partial(Ask, what, namespace)))  # type: ignore[arg-type]

        return add if self._commands else lambda: None

    def _write_states(self, robots: list[Status], now: float) -> None:
        lines = []
        for robot in robots:
            level, words = robot.headline(now)
            lines.append(f"{_dot(level)} <b>{html.escape(robot.name)}</b> {html.escape(words)}")
        if self._robots.stopped is not None and now - self._robots.stopped < 60.0:
            lines.insert(0, f"<b>{html.escape(stop_words(self._robots.stopped, robots, now))}</b>")
        _set(self._summary, _lines(lines or ["No inference node is there yet."]))

    def _write_cards(self, robots: list[Status], now: float) -> None:
        for robot in robots:
            arm = self._arms.get(robot.namespace)
            self._cards[robot.namespace].write(robot, arm.distance if arm else math.nan, now)

    def _draw_paths(self, robots: list[Status], now: float) -> None:
        for arm in self._arms.values():
            arm.show_path()

    def _sample(self, robots: list[Status], now: float) -> None:
        for name, arm in self._arms.items():
            self._cards[name].sample(arm, now)

    def _plot(self, robots: list[Status], now: float) -> None:
        for card in self._cards.values():
            card.plot(now)


class _Card:
    """What one robot tells, in a tab of its own.

    Attributes:
        problem: What the page cannot show of it, and why.
    """

    def __init__(
        self, server: viser.ViserServer, tabs: viser.GuiTabGroupHandle, name: str, add_buttons: Callable[[], None]
    ) -> None:
        self.problem = "it has not described itself yet"
        self._history: deque[tuple[float, float, float]] = deque(maxlen=int(60 * _MINUTES / _SAMPLES))
        self._before: tuple[float, np.ndarray] | None = None
        self._tab = tabs.add_tab(name)
        with self._tab:
            self._words = server.gui.add_html("")
            add_buttons()
            self._plot = server.gui.add_uplot(
                (np.zeros(1), np.zeros(1), np.zeros(1)),
                (
                    {"label": "s"},
                    {"label": "to the goal, m", "stroke": "#1eb450", "width": 2},
                    {"label": "fastest joint, rad/s", "stroke": "#4678dc", "width": 1},
                ),
                scales={"x": {"time": False, "range": (-60.0 * _MINUTES, 0.0)}},
                height=170,
            )

    def write(self, robot: Status, distance: float, now: float) -> None:
        level, words = robot.headline(now)
        lines = [f"{_dot(level)} <b>{html.escape(words)}</b>"]
        told = robot.details(now)
        if math.isfinite(distance):
            told.insert(0, ("to the goal", f"{distance:.3f} m"))
        if self.problem:
            told.append(("note", self.problem))
        lines += [f"{html.escape(what)}: <b>{html.escape(value)}</b>" for what, value in told]
        _set(self._words, _lines(lines))

    def sample(self, arm: ArmView, now: float) -> None:
        before = self._before
        speed = math.nan if before is None else arm.fastest(before[1], now - before[0])
        self._before = now, arm.position.copy()
        self._history.append((now, arm.distance, speed))

    def plot(self, now: float) -> None:
        if len(self._history) > 1:
            times, *values = np.array(self._history).T
            self._plot.data = times - now, *map(np.nan_to_num, values)  # of one that is none, nothing would be drawn

    def remove(self) -> None:
        self._tab.remove()


def _dot(level: Level) -> str:
    return f"<span style='color:rgb{level.value}'>&#9679;</span>"


def _lines(lines: Iterable[str]) -> str:
    return f"<div style='margin:0 1em 0.6em;font-size:0.85em;overflow-wrap:anywhere'>{'<br>'.join(lines)}</div>"


def _set(handle: viser.GuiHtmlHandle, content: str) -> None:
    if handle.content != content:
        handle.content = content
