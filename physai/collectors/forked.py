"""What collectors whose processes are forked from the learner's have in common."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from functools import partial
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import multiprocessing, nn
from torchrl.collectors import MultiCollector, _runner

from physai.collectors.worker import MakeEnv, WorkerCollector, acting, each
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError
from physai.processes import follow, signals_wait


class RobotMultiCollector(MultiCollector):
    """Several processes on this machine, each with robots of its own.

    What a process acts with (:func:`acting`) lies in shared memory; the learner renews it between two batches of that
    process, when it stands still: no lock is needed that a killed process could keep.

    Args:
        workers: Number of processes.
        make_env: See :data:`physai.collectors.worker.MakeEnv`.
        policy: What acts; its copies do.
        env: The learner's; copies of what it renews there are used.
        **torchrl: For TorchRL's collector.
    """

    def __init__(
        self,
        workers: int,
        make_env: MakeEnv,
        policy: TensorDictModuleBase,
        env: TransformedRobotEnv,
        **torchrl: Any,
    ) -> None:
        learner = acting(policy, env)
        self._copies: list[Any] = [deepcopy(learner).cpu().share_memory() for _ in range(workers)]
        # The tensors themselves: load_state_dict would take half a millisecond of every batch.
        self._weights, *self._weights_of = (list(one.state_dict().values()) for one in (learner, *self._copies))
        threads, method = torch.get_num_threads(), multiprocessing.get_start_method(allow_none=True)
        before = set(multiprocessing.active_children())
        # Forked workers start at once; fresh ones would import for seconds.
        multiprocessing.set_start_method("fork", force=True)
        try:
            with signals_wait(), self._one_line():
                super().__init__(
                    [
                        partial(_start_worker, os.getpid(), make_env, copy, worker)
                        for worker, copy in enumerate(self._copies)
                    ],
                    policy_factory=[partial(_same, copy["policy"]) for copy in self._copies],
                    collector_class=WorkerCollector,
                    use_buffers=True,
                    auto_register_policy_transforms=False,
                    **torchrl,
                )
                Finalize(self, _kill, (self.procs,), exitpriority=0)  # where a signal leaves no time for a shutdown
        except BaseException:  # a signal, too: they take no notice of it, and Python would wait for them
            _kill(set(multiprocessing.active_children()) - before)
            raise
        finally:
            multiprocessing.set_start_method(method, force=True)
            torch.set_num_threads(threads)  # those are the learner's: TorchRL takes one away for each worker

    def _renew(self, worker: int) -> None:
        """Let a worker that stands still act as the learner would now."""
        for copy, weights in zip(self._weights_of[worker], self._weights, strict=True):
            copy.copy_(weights)

    def iterator(self) -> Iterator[TensorDictBase]:
        """Collect batches.

        Raises:
            UserError: If a worker has died.
        """
        return each(super().iterator(), self._one_line)

    @contextmanager
    def _one_line(self) -> Iterator[None]:
        """Context in which whatever TorchRL says of a process that is gone becomes one line; the others end, too."""
        try:
            yield
        except UserError as error:  # a worker's own, with its traceback behind it
            raise UserError(str(error).partition("\n")[0]) from error
        except (RuntimeError, ValueError, OSError, EOFError) as error:
            open_ones = [process for process in getattr(self, "procs", []) if not process._closed]
            gone = connection.wait([process.sentinel for process in open_ones], timeout=1)
            for process in open_ones:
                if process.sentinel in gone:  # of a process that dies, a pipe breaks first; its exit code comes last
                    process.join(timeout=1)
            codes = [str(process.exitcode) for process in open_ones if process.exitcode is not None]
            _kill(open_ones)
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


def _start_worker(learner: int, make_env: MakeEnv, copy: nn.ModuleDict, worker: int) -> TransformedRobotEnv:
    follow(learner)
    if hasattr(os, "SCHED_BATCH"):  # Linux; whoever is woken does not take the processor from the one that wakes it
        with suppress(OSError):  # where that is not allowed, it is a little slower
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    # After each batch TorchRL waits for another order, 1 ms long; here, none ever comes before the batch has arrived.
    # Without the wait two processes collect 4 to 9 % more.
    _runner._MIN_TIMEOUT = 0.0
    env = make_env(worker)
    env.adopt(copy)
    return env


def _kill(processes: Iterable[BaseProcess]) -> None:
    for process in processes:
        with suppress(ValueError):  # closed, as one that ended in good order
            process.kill()


def _same(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    return policy
