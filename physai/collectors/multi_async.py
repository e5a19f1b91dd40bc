"""Several processes that collect while the learner learns."""

from collections import deque
from collections.abc import Iterator
from queue import Empty
from typing import Any

from tensordict import TensorDictBase
from torchrl.collectors import MultiAsyncCollector

from physai.collectors.forked import RobotMultiCollector


class RobotMultiAsyncCollector(RobotMultiCollector, MultiAsyncCollector):
    """TorchRL's collector of several processes, each of which brings whole batches, in the order in which they come.

    Batches are [N / processes, T * processes]: as many frames as elsewhere, all from the robots of one process, which
    acted throughout as the learner would have when the batch was begun. That is as many updates ago as there are
    processes. Order, and so the outcome, is the machine's: ``state`` holds all workers between two batches and goes on
    from there, but not bit for bit; batches that nobody has learnt from are collected anew. The arguments are those of
    :class:`RobotMultiCollector` and TorchRL's.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._ready: deque[tuple[int, int, TensorDictBase]] = deque()
        self._begun, self._ordered = False, 0
        super().__init__(*args, **kwargs)

    def iterator(self) -> Iterator[TensorDictBase]:
        """Collect batches.

        Raises:
            UserError: If a worker has died.
        """
        self._begun, self._ordered = True, self._frames
        for worker in range(self.num_workers):
            self._renew(worker)
        yield from super().iterator()

    @property
    def _queue_len(self) -> int:
        return self.num_workers  # in a shorter queue, batches that have to wait are thrown away

    def _get_from_queue(self, timeout: float | None = None) -> tuple[int, int, TensorDictBase]:
        worker, number, batch = self._ready.popleft() if self._ready else super()._get_from_queue(timeout)
        self._renew(worker)  # it waits for its next order, which TorchRL gives now
        return worker, number, batch

    def _should_use_random_frames(self) -> bool:
        """Answer for the next batch to be ordered; TorchRL asks once for each, while others are still to come."""
        self._ordered += self.requested_frames_per_batch
        return self._ordered <= self.init_random_frames

    def state(self) -> dict[str, Any]:
        """Return the state of all workers, as soon as each has finished its batch."""
        with self._one_line():
            while self._begun and len(self._ready) < self.num_workers:
                try:
                    self._ready.append(super()._get_from_queue(timeout=1))
                except Empty:
                    if any(process.exitcode is not None for process in self.procs):
                        raise RuntimeError("a worker has died") from None
        return super().state()
