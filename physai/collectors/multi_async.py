"""Processes that collect while the learner learns."""

from collections.abc import Iterator
from queue import Empty
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import MultiAsyncCollector

from physai.collectors.forked import RobotMultiCollector


class RobotMultiAsyncCollector(RobotMultiCollector, MultiAsyncCollector):
    """TorchRL's collector of processes, each of which brings whole batches, in an order that TorchRL leaves to chance.

    Here they take turns. A process begins its next batch when the learner takes one from it, and acts throughout as the
    learner would have then, so that a batch misses as many updates as there are processes. The outcome does not depend
    on who is faster, and the collector continues from ``state``, which holds the batches that wait for the learner, bit
    for bit.

    Batches are [N / processes, T * processes]: as many frames as elsewhere, all from the robots of one process. The
    arguments are those of :class:`RobotMultiCollector` and TorchRL's.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._begun, self._ordered = False, 0
        self._waiting: dict[int, TensorDictBase] = {}  # for the learner, by worker
        super().__init__(*args, **kwargs)

    def iterator(self) -> Iterator[TensorDictBase]:
        """Collect batches.

        Raises:
            UserError: If a worker has died.
        """
        with self._one_line():
            for worker in range(self.num_workers):
                if not self._begun and worker not in self._waiting:
                    self._order(worker)
        self._begun = True
        while self._frames < self.total_frames:
            worker = self._frames // self.requested_frames_per_batch % self.num_workers
            with self._one_line():
                self._receive(worker)
                batch = self._waiting.pop(worker)
                self._order(worker)
            self._frames += batch.numel()
            yield batch

    def _order(self, worker: int) -> None:
        """Let a worker that stands still begin a batch."""
        self._renew(worker)
        at_random = self._ordered < self.init_random_frames
        self._ordered += self.requested_frames_per_batch
        self.pipes[worker].send((worker, "continue_random" if at_random else "continue"))

    def _receive(self, worker: int) -> None:
        """Wait for a worker's batch."""
        while worker not in self._waiting:
            try:
                sender, _, batch = self._get_from_queue(timeout=1)
            except Empty as error:
                if any(process.exitcode is not None for process in self.procs):
                    raise RuntimeError("a worker has died") from error
            else:
                self._waiting[sender] = batch

    @property
    def _queue_len(self) -> int:
        return self.num_workers  # in a shorter queue, batches that have to wait are thrown away

    def state(self) -> dict[str, Any]:
        """Return the state of all workers, as soon as each has finished its batch, and these batches."""
        if self._begun:
            with self._one_line():
                for worker in range(self.num_workers):
                    self._receive(worker)
        waiting = {worker: batch.to_dict(retain_none=False) for worker, batch in self._waiting.items()}
        return super().state() | {"waiting": waiting}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned, in a collector made from the same config."""
        super().set_state(state)
        self._waiting = {
            worker: TensorDict(batch, batch_size=batch["action"].shape[:2])
            for worker, batch in state["waiting"].items()
        }
        self._ordered = self._frames + len(self._waiting) * self.requested_frames_per_batch
