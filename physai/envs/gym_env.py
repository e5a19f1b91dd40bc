"""The Gymnasium shells: one robot, or N as one vector env; neither needs TorchRL."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from physai.compose import compose
from physai.config import validate
from physai.envs.simulation import EnvConfig, Simulation
from physai.envs.viewing import has_screen, make_viewer, show

if TYPE_CHECKING:
    from physai.physics.following_viewer import FollowingViewer
    from physai.physics.stick_figure import StickFigure
    from physai.physics.viewer import Viewer

Array = NDArray[Any]


def _simulate(env: str, overrides: Sequence[str], num_envs: int) -> Simulation:
    return Simulation(validate(EnvConfig, compose("train", [f"env={env}", *overrides]).env), num_envs, seed=0)


def _spaces(simulation: Simulation) -> tuple[spaces.Box, spaces.Box]:
    low, high = simulation.task.observation.bounds
    observation = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
    return observation, spaces.Box(-1.0, 1.0, simulation.spec.joint_command.shape, np.float32)


def _errors(simulation: Simulation) -> dict[str, Array]:
    """How far the robots are from their goals, by name, [N] each."""
    names = (tolerance.name for tolerance in simulation.task.tolerances)
    return dict(zip(names, simulation.error.T, strict=True))


class RobotGymEnv(gymnasium.Env[Array, Array]):
    """One robot at a task, without randomization; observation and action as in ``physai.tasks``.

    ``info`` holds ``is_success`` and the task's errors by name, such as ``distance`` (m).

    Args:
        env: A file of ``conf/env``.
        render_mode: ``rgb_array`` renders on the CPU without a screen; ``human`` opens a PyBullet window.
        overrides: Hydra overrides such as ``env.task.max_steps=100``.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 50}  # noqa: RUF012

    def __init__(self, env: str, render_mode: str | None = None, overrides: Sequence[str] = ()) -> None:
        self.simulation = _simulate(env, overrides, 1)
        self.metadata = {**self.metadata, "render_fps": round(1 / self.simulation.config.control_dt)}
        if not has_screen():
            self.metadata["render_modes"] = ["rgb_array"]
        self.render_mode = render_mode
        self.observation_space, self.action_space = _spaces(self.simulation)
        self._viewer: Viewer | FollowingViewer | StickFigure | None = None
        self._seeded = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        if seed is not None or not self._seeded:
            self.simulation.seed(int(self.np_random.integers(2**63 - 1)))
            self._seeded = True
        self.simulation.reset()
        self._show()
        return self.simulation.observe()[0], self._info()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Apply an action [n] in [-1, 1] for one control period."""
        ended = self.simulation.step(np.asarray(action, np.float32)[None])
        self._show()
        reward, terminated, truncated = (column.item() for column in ended)
        return self.simulation.observe()[0], reward, terminated, truncated, self._info()

    def _info(self) -> dict[str, Any]:
        errors = {name: error.item() for name, error in _errors(self.simulation).items()}
        return {"is_success": self.simulation.success.item(), **errors}

    def _show(self) -> None:
        if self.render_mode == "human":
            self._picture()
            if self.simulation.config.simulated:  # what is not takes its time by itself
                time.sleep(self.simulation.config.control_dt)

    def _picture(self) -> Array | None:
        if self._viewer is None:
            self._viewer = make_viewer(self.simulation, window=self.render_mode == "human")
        return show(self._viewer, self.simulation)

    def render(self) -> Array | None:
        """Return an image [height, width, 3] uint8 in the mode ``rgb_array``."""
        return self._picture() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the simulation and the viewer."""
        self.simulation.close()
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None


class RobotVectorEnv(VectorEnv[Array, Array, Array]):
    """N robots as a Gymnasium vector env; an episode that is over restarts at the next step.

    Args:
        env: A file of ``conf/env``.
        num_envs: N.
        render_mode: ``rgb_array`` shows the first robot.
        overrides: Hydra overrides.
    """

    metadata = {  # noqa: RUF012
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "render_modes": ["rgb_array"],
        "render_fps": 50,
    }

    def __init__(
        self,
        env: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        overrides: Sequence[str] = (),
    ) -> None:
        self.simulation = _simulate(env, overrides, num_envs)
        self.metadata = {**self.metadata, "render_fps": round(1 / self.simulation.config.control_dt)}
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_observation_space, self.single_action_space = _spaces(self.simulation)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over = np.zeros(num_envs, bool)
        self._viewer: Viewer | FollowingViewer | StickFigure | None = None
        self._seeded = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode in every row."""
        super().reset(seed=seed)
        if seed is not None or not self._seeded:
            self.simulation.seed(int(self.np_random.integers(2**63 - 1)))
            self._seeded = True
        self.simulation.reset()
        self._over = np.zeros(self.num_envs, bool)
        return self.simulation.observe(), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Apply actions [N, n]; rows whose episode is over start a new one instead."""
        ended = self.simulation.step(np.asarray(actions, np.float32), restart=self._over)
        reward, terminated, truncated = (column[:, 0] for column in ended)
        self._over = terminated | truncated
        info = {"is_success": self.simulation.success[:, 0], **_errors(self.simulation)}
        return self.simulation.observe(), reward, terminated, truncated, info

    def render(self) -> tuple[Array, ...] | None:
        """Return an image of the first robot."""
        if self.render_mode != "rgb_array":
            return None
        if self._viewer is None:
            self._viewer = make_viewer(self.simulation)
        image = show(self._viewer, self.simulation)
        return None if image is None else (image,)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulation and the viewer."""
        self.simulation.close()
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
