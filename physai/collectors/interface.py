"""What the training loop knows of a collector."""

from collections.abc import Iterator
from typing import Any, Protocol

from tensordict import TensorDictBase


class FrameSource(Protocol):
    """Made by ``make_collector``."""

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Collect batches [N, T]: N robots, T steps each.

        Raises:
            UserError: If a process that collects is gone.
        """

    def state(self) -> dict[str, Any]:
        """Return what ``set_state`` needs to go on.

        Raises:
            UserError: If a process that collects is gone.
        """

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned, in a collector made from the same config, before its first batch."""

    def shutdown(self) -> None:
        """End whatever was started."""
