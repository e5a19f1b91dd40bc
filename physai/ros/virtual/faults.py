"""What can go wrong between a robot's sensors and a node, on purpose."""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from physai.deploy import JointState
from physai.deploy.parameters import Parameters, parameter


@dataclass(frozen=True)
class FaultConfig(Parameters):
    """Faults of /joint_states; none by default, and all of them can be changed while the robot runs."""

    fault_noise: float = parameter(0.0, "standard deviation of noise on positions", "rad", 0.0, 10.0)
    fault_nan: float = parameter(0.0, "probability that a message has a NaN among its positions", "", 0.0, 1.0)
    fault_delay: float = parameter(0.0, "messages are sent this much later", "s", 0.0, 10.0)
    fault_drop: float = parameter(0.0, "probability that a message is lost", "", 0.0, 1.0)
    fault_reorder: bool = parameter(False, "joints are named in another order in every message")
    fault_empty_velocity: bool = parameter(False, "messages have no velocities")
    fault_stop: bool = parameter(False, "no messages at all")


class Faults:
    """Spoils joint states.

    Args:
        config: How.
        seed: Of the random faults.
    """

    def __init__(self, config: FaultConfig, seed: int) -> None:
        self.config = config
        self._random = np.random.default_rng(seed)
        self._waiting: deque[tuple[float, JointState]] = deque()

    def apply(self, state: JointState, now: float) -> list[JointState]:
        """Take a joint state at a time, s, and return those that are to be sent now, spoilt."""
        config, draw = self.config, self._random
        if not config.fault_stop and draw.random() >= config.fault_drop:
            self._waiting.append((now + config.fault_delay, self._spoil(state)))
        due = []
        while self._waiting and self._waiting[0][0] <= now:
            due.append(self._waiting.popleft()[1])
        return [] if config.fault_stop else due

    def _spoil(self, state: JointState) -> JointState:
        config, draw = self.config, self._random
        names, position, velocity = np.array(state.names), np.array(state.position), np.array(state.velocity)
        effort = state.effort
        position = position + config.fault_noise * draw.standard_normal(len(position))
        if draw.random() < config.fault_nan:
            position[draw.integers(len(position))] = np.nan
        if config.fault_reorder:
            order = draw.permutation(len(names))
            names, position, velocity = names[order], position[order], velocity[order]
            effort = [effort[joint] for joint in order] if effort else effort  # of a robot that tells it
        if config.fault_empty_velocity:
            velocity = velocity[:0]
        return replace(
            state, names=names.tolist(), position=position.tolist(), velocity=velocity.tolist(), effort=effort
        )
