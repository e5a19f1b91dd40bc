"""Several processes, many robots in each."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import multiprocessing
from torchrl.collectors import MultiSyncCollector

from physai.collectors.single import RobotCollector
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError
from physai.transforms.normalization import Normalizer

MakeEnv = Callable[[int], TransformedRobotEnv]
"""Builds the env of a worker from its number, in the worker's process."""


class WorkerCollector(RobotCollector):
    """What collects in a worker."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs, track_traj_ids=False)

    def rollout(self) -> TensorDictBase:
        """Collect one batch."""
        batch = super().rollout()
        # TorchRL counts frames by this key; what it says of trajectories nobody asks.
        return batch.set(("collector", "traj_ids"), torch.zeros(batch.shape, dtype=torch.int64))

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the env and of this process' random numbers."""
        return self.state() | {"random": torch.get_rng_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.set_state(state_dict)
        torch.set_rng_state(state_dict["random"])


class RobotMultiCollector(MultiSyncCollector):
    """TorchRL's collector of several processes, which collect at the same time, each from robots of its own.

    Batches are [N, T], the robots of one process after those of the other. All see the same weights and normalization,
    in shared memory: the learner changes them while the workers wait. Like a single process, they continue from
    ``state`` bit for bit.

    Args:
        workers: Number of processes.
        make_env: See :data:`MakeEnv`.
        policy: What acts; its weights move to shared memory.
        normalizer: The learner's; its statistics move to shared memory.
        frames_per_batch: Of all workers together.
        total_frames: Where collection ends.
    """

    def __init__(
        self,
        workers: int,
        make_env: MakeEnv,
        policy: TensorDictModuleBase,
        normalizer: Normalizer,
        frames_per_batch: int,
        total_frames: int,
    ) -> None:
        policy.share_memory()
        normalizer.share_memory()
        threads, method = torch.get_num_threads(), multiprocessing.get_start_method(allow_none=True)
        # Forked workers start at once; fresh ones would import for seconds.
        multiprocessing.set_start_method("fork", force=True)
        try:
            with self._one_line():
                super().__init__(
                    [partial(_start_worker, os.getpid(), make_env, normalizer, worker) for worker in range(workers)],
                    policy_factory=partial(_same, policy),
                    collector_class=WorkerCollector,
                    frames_per_batch=frames_per_batch,
                    total_frames=total_frames,
                    cat_results=0,
                    use_buffers=True,
                    auto_register_policy_transforms=False,
                )
        finally:
            multiprocessing.set_start_method(method, force=True)
            torch.set_num_threads(threads)  # those are the learner's: TorchRL takes one away for each worker

    def iterator(self) -> Iterator[TensorDictBase]:
        """Collect batches.

        Raises:
            UserError: If a worker has died.
        """
        batches = super().iterator()
        while True:
            with self._one_line():
                batch = next(batches, None)
            if batch is None:
                return
            yield batch

    @contextmanager
    def _one_line(self) -> Iterator[None]:
        """Context in which whatever TorchRL says of a process that is gone becomes one line; the others end, too."""
        try:
            yield
        except UserError as error:  # a worker's own, with its traceback behind it
            raise UserError(str(error).partition("\n")[0]) from error
        except (RuntimeError, ValueError, OSError, EOFError) as error:
            open_ones = [process for process in getattr(self, "procs", []) if not process._closed]
            codes = [str(process.exitcode) for process in open_ones if process.exitcode is not None]
            for process in open_ones:
                process.kill()
            reason = f"exit code {', '.join(codes)}" if codes else (str(error) or type(error).__name__).splitlines()[0]
            raise UserError(f"a process that collects has ended ({reason})") from error

    def state(self) -> dict[str, Any]:
        """Return the state of all workers."""
        with self._one_line():
            return dict(self.state_dict())

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned, in a collector made from the same config."""
        with self._one_line():
            self.load_state_dict(state)


def _start_worker(learner: int, make_env: MakeEnv, normalizer: Normalizer, worker: int) -> TransformedRobotEnv:
    # These reach all processes of a terminal or a container; the learner says what comes of it.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)
    if sys.platform == "linux":  # pipes do not tell that the learner was killed: each worker holds both ends of others'
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != learner:
            sys.exit(1)
    env = make_env(worker)
    env.normalization.normalizer = normalizer
    return env


_PR_SET_PDEATHSIG = 1


def _same(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    return policy
