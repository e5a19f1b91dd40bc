"""A layout of Foxglove for robots: the arms in 3-D, their states, joints, commands and diagnostics."""

import math
from collections.abc import Iterator, Mapping, Sequence

from foxglove import layouts

from physai.ros.topics import joint_states
from physai.ros.topics.commands import controller_topic
from physai.signals import Quantity

_APART = 1.5  # m from robot to robot: nobody knows where they really stand
_PLOTTED = 8  # robots whose joints are plotted: more of them nobody can read


def layout(robots: Mapping[str, tuple[str, Sequence[str]]]) -> str:
    """Return the JSON that Foxglove imports, for live robots and for recordings of them.

    Args:
        robots: By namespace (empty for none), its base's frame, and the joints as its joint states name them.
    """
    states = [
        layouts.StateTransitionsSeries(value=f"{namespace}/inference_node/state.data", label=namespace or "state")
        for namespace in robots
    ]
    plots = [
        layouts.StackItem(panel=_joints(namespace, joints), size=0.5)
        for namespace, (_, joints) in list(robots.items())[:_PLOTTED]
    ]
    told = layouts.DiagnosticsSummaryConfig(topic_to_render="/diagnostics", sort_by_level=True)
    left = layouts.SplitContainer(
        direction="column",
        items=[
            layouts.SplitItem(proportion=3, content=_scene(robots)),
            layouts.SplitItem(
                proportion=1,
                content=layouts.StateTransitionsPanel(config=layouts.StateTransitionsConfig(paths=states)),
            ),
        ],
    )
    right = layouts.SplitContainer(
        direction="column",
        items=[
            layouts.SplitItem(proportion=1, content=layouts.DiagnosticsSummaryPanel(config=told)),
            layouts.SplitItem(proportion=3, content=layouts.StackContainer(panels=plots, title="Joints")),
        ],
    )
    sides = [layouts.SplitItem(proportion=3, content=left), layouts.SplitItem(proportion=2, content=right)]
    return layouts.Layout(content=layouts.SplitContainer(direction="row", items=sides)).to_json()


def _scene(robots: Mapping[str, tuple[str, Sequence[str]]]) -> layouts.ThreeDeePanel:
    arms = {
        f"{namespace}/inference_node/robot_description": layouts.BaseRendererUrdfTopicSettings(
            visible=True,
            control_mode="jointStates",
            joint_states_topic=f"{namespace}/{joint_states.TOPIC}",
            label=namespace or "robot",
        )
        for namespace in robots
    }
    goals = {
        f"{namespace}/inference_node/goal": layouts.BaseRendererPoseTopicSettings(visible=True) for namespace in robots
    }
    places = {
        f"frame:{base}": layouts.BaseRendererLayerSettingsTransform(xyz_offset=place)
        for (base, _), place in zip(robots.values(), _places(len(robots)), strict=True)
    }
    return layouts.ThreeDeePanel(
        config=layouts.ThreeDeeConfig(
            follow_tf="world",
            fixed_frame="world",
            topics={**arms, **goals},
            transforms=places if len(robots) > 1 else {},
        )
    )


def _places(count: int) -> Iterator[tuple[float, float, float]]:
    """A square of robots."""
    side = max(1, math.ceil(math.sqrt(count)))
    for number in range(count):
        yield (_APART * (number % side), _APART * (number // side), 0.0)


def _joints(namespace: str, joints: Sequence[str]) -> layouts.PlotPanel:
    states, commands = f"{namespace}/{joint_states.TOPIC}", f"{namespace}/{controller_topic(Quantity.JOINT_VELOCITY)}"
    series = [
        layouts.PlotSeries(value=f"{states}.position[{number}]", label=f"{joint}, rad")
        for number, joint in enumerate(joints)
    ]
    series += [
        layouts.PlotSeries(value=f"{commands}.data[{number}]", label=f"command {number + 1}, rad/s")
        for number in range(len(joints))
    ]
    return layouts.PlotPanel(config=layouts.PlotConfig(paths=series), title=namespace or "joints")
