"""Several processes that collect at the same time, while the learner waits."""

from typing import Any

from torchrl.collectors import MultiSyncCollector

from physai.collectors.forked import RobotMultiCollector


class RobotMultiSyncCollector(RobotMultiCollector, MultiSyncCollector):
    """TorchRL's collector of several processes, each of which brings its share of every batch.

    Batches are [N, T], the robots of one process after those of the other. Like a single process, they continue from
    ``state`` bit for bit. The arguments are those of :class:`RobotMultiCollector` and TorchRL's.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs, cat_results=0, update_at_each_batch=True)

    def update_policy_weights_(self, *_: Any, **__: Any) -> None:
        """Renew what the workers act with; TorchRL calls it before each batch."""
        for worker in range(len(self._copies)):
            self._renew(worker)
