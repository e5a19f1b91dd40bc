"""Actuator delay: a command reaches the motors some control steps after it was given."""

import numpy as np


class ActuatorDelay:
    """Holds back the commands of N robots, each by a delay of its own; one per simulation, and one in a virtual robot.

    Args:
        num_robots: N.
        joints: n.
    """

    def __init__(self, num_robots: int, joints: int) -> None:
        self._delay = np.zeros(num_robots, np.int64)
        self._commands = np.zeros((1, num_robots, joints))  # [k] was given k steps ago
        self._robots = np.arange(num_robots)

    def reset(self, rows: np.ndarray, command: np.ndarray, delay: np.ndarray | None = None) -> None:
        """Start again in ``rows`` [r]: they get ``command`` [r, n] until their first one arrives.

        Args:
            rows: Which robots.
            command: What keeps each of them where it is.
            delay: New delays [r], in control steps; None keeps the old ones.
        """
        if delay is not None:
            self._delay = self._delay.copy()
            self._delay[rows] = delay
            missing = int(self._delay.max()) + 1 - len(self._commands)
            if missing > 0:
                self._commands = np.concatenate([self._commands, np.repeat(self._commands[-1:], missing, axis=0)])
        self._commands[:, rows] = command

    def __call__(self, command: np.ndarray) -> np.ndarray:
        """Take commands [N, n]; return those that arrive now."""
        if len(self._commands) == 1:
            return command
        self._commands[1:] = self._commands[:-1]
        self._commands[0] = command
        return self._commands[self._delay, self._robots]

    def state(self) -> dict[str, np.ndarray]:
        """Return what ``set_state`` needs to go on bit for bit."""
        return {"delay": self._delay.copy(), "commands": self._commands.copy()}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what ``state`` returned."""
        self._delay, self._commands = state["delay"].copy(), state["commands"].copy()
