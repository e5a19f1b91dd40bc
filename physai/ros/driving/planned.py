"""Motions as a controller asks for them: they answer as a policy does, so that all that makes a policy safe holds."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from physai.deploy import Metadata
from physai.deploy.metadata import GOAL, MEMORY, NEW_MEMORY
from physai.identify.motions import Excitation
from physai.signals import Quantity, Signal, Tolerance
from physai.signals.region import Box

_MOST = 1_000_000.0  # that a memory counts to: single precision holds all of it


class PlannedMotions:
    """Drives a robot through motions. Its goal is home, and its error the time until all is done and it is there, s.

    So the controller sees progress as long as the motions go on, and a goal that is reached when they are over. What
    it remembers is how many steps it has taken: asked again too soon it answers the same; and zero says that the robot
    was stopped meanwhile, which breaks off a motion.

    Args:
        metadata: Of a policy file of the robot, which takes joint velocities.
        sha256: Of this file.
        excitation: The motions; their period is that of the policy.
    """

    def __init__(self, metadata: Metadata, sha256: str, excitation: Excitation) -> None:
        joints, home = metadata.joints, metadata.home
        memory = {name: Signal(name, Quantity.MEMORY, (1,)) for name in (MEMORY, NEW_MEMORY)}
        sensed = next(signal for signal in metadata.inputs if signal.name == "joint_position")
        goal = Signal.of_joints(GOAL, Quantity.JOINT_POSITION, joints, home, home)
        self.metadata = replace(
            metadata,
            inputs=(sensed, goal, memory[MEMORY]),
            outputs=(metadata.command, memory[NEW_MEMORY]),
            region=Box(tuple(home.tolist()), tuple(home.tolist())),
            tolerances=(Tolerance("time left", "s", excitation.period),),
            golden={},
        )
        self.sha256 = sha256
        self._excitation = excitation
        self._steps = 0.0
        self._velocity = np.zeros_like(home)

    def __call__(self, *inputs: Any) -> Any:
        """Return the command [n], and how many steps were taken, [1]; see :class:`physai.deploy.Policy`."""
        position, _, memory = inputs
        taken = float(memory[0])
        if taken == 0.0:
            self._excitation.interrupt()
            self._steps = 0.0
        if taken == self._steps:
            self._velocity = self._excitation.step(np.asarray(position))
            self._steps = self._steps % _MOST + 1.0
        return self._velocity, np.array([self._steps], np.float32)

    def error(self, joint_position: Sequence[float] | np.ndarray, goal: Sequence[float] | np.ndarray) -> np.ndarray:
        """How long it takes until all is done, s, [1], of a robot whose joints are there, rad, [n]."""
        return np.array([self._excitation.left(np.asarray(joint_position))])
