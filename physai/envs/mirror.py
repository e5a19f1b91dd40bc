"""Frames of robots on legs as their mirror images would have seen them."""

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.robots import Mirror
from physai.signals import Quantity
from physai.transforms.normalization import Normalizer

_VECTOR, _TURN, _TWIST = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, -1.0, -1.0)
_OF_AXES = {Quantity.DIRECTION: _VECTOR, Quantity.ANGULAR_VELOCITY: _TURN, Quantity.TWIST: _TWIST}
_OF_JOINTS = Quantity.JOINT_POSITION, Quantity.JOINT_VELOCITY, Quantity.ACTION
_ACTIONS = "action", "latent_action", "past_actions"


class MirrorImage:
    """Turns frames into those of the mirror image: left is right, and a gait is half a period on.

    What is sensed is mirrored by what it is, and the task's module makes the observation of that anew, which is
    normalized with the statistics of now. A centre of mass that the description has off the middle stays there.

    Args:
        simulation: Of whose robots the frames are.
        normalizer: What observations are normalized with.

    Raises:
        UserError: If the robot has no legs, its sides differ, or something that it senses has no mirror image.
    """

    def __init__(self, simulation: Simulation, normalizer: Normalizer) -> None:
        spec, self._normalizer, self._module = simulation.spec, normalizer, simulation.task.module
        mirror = Mirror.of(spec)
        joints = mirror.order, mirror.sign
        self._maps: dict[str, tuple[Tensor, Tensor]] = {}
        self._clock: str | None = None
        for signal in simulation.sensed:
            if signal.quantity in _OF_JOINTS:
                self._add(signal.name, *joints)
            elif signal.quantity in _OF_AXES:
                self._add(signal.name, np.arange(3), np.array(_OF_AXES[signal.quantity]))
            elif signal.quantity is Quantity.TIME:
                self._clock = signal.name
            else:
                raise UserError(f"what '{signal.name}' is to the mirror image of a robot is not known")
        for name in _ACTIONS:
            self._add(name, *joints)
        self._add("base_velocity", np.arange(3), np.array(_VECTOR))
        n, columns = len(spec.joints), simulation.layout.columns
        order, sign = np.arange(len(simulation.layout.nominal)), np.ones(len(simulation.layout.nominal))
        for name, place in columns.items():
            if name == "link_mass":
                order[place] = place.start + mirror.links(spec)
            elif name == "center_of_mass":
                sign[place] = _VECTOR
            elif place.stop - place.start == n:
                order[place] = place.start + mirror.order
                sign[place] = mirror.sign if name == "encoder_offset" else 1.0
        self._add("physics_parameters", order, sign)
        self._add("relative_parameters", order, sign)

    def _add(self, name: str, order: np.ndarray, sign: np.ndarray) -> None:
        self._maps[name] = torch.from_numpy(order).long(), torch.from_numpy(sign).float()

    @torch.no_grad()
    def __call__(self, frames: TensorDictBase) -> TensorDictBase:
        """Return what is otherwise in the mirror image of frames [...]."""
        image = frames.empty()
        for name, (order, sign) in self._maps.items():
            if (value := frames.get(name, None)) is not None:
                blocks = value.unflatten(-1, (-1, len(order)))  # past actions are several
                image.set(name, (blocks[..., order] * sign).flatten(-2))
        if self._clock is not None:
            period = self._module.period
            image.set(self._clock, torch.remainder(frames.get(self._clock) + 0.5 * period, period))
        seen = [image.get(key).flatten(0, -2) for key in (*self._module.senses, "goal")]
        for key, value in zip(("observation", "features"), self._module(*seen), strict=True):
            image.set(key, value.unflatten(0, frames.batch_size))
        return image.set("normalized_observation", self._normalizer(image.get("observation")))
