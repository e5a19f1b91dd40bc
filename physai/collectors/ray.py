"""Processes that Ray starts, on this machine or on a cluster."""

import contextlib
import inspect
import os
import signal
import subprocess
from collections.abc import Iterator
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors.distributed import RayCollector

from physai.collectors.worker import MakeEnv, WorkerCollector, acting, each
from physai.config import nearest
from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError
from physai.processes import SIGNALS, handling, kill_with_this

_START_SECONDS = 60  # for a cluster that may be busy


class RobotRayCollector(RayCollector):
    """TorchRL's collector on Ray: several processes, each of which brings its share of every batch.

    Batches are [N, T], the robots of one process after those of the other. What they act with is sent to them before
    each batch. With the same seed the frames are those of :mod:`physai.collectors.multi_sync`, and they
    continue from ``state`` bit for bit, on machines of one kind.

    Args:
        workers: Number of processes; each takes one CPU.
        make_env: See :data:`physai.collectors.worker.MakeEnv`; Ray pickles it.
        policy: What acts; Ray pickles a copy of it.
        env: The learner's.
        ray_init: Arguments of ``ray.init``.
        **torchrl: For TorchRL's collector.

    Raises:
        UserError: If Ray does not start, or has no room for the workers.
    """

    def __init__(
        self,
        workers: int,
        make_env: MakeEnv,
        policy: TensorDictModuleBase,
        env: TransformedRobotEnv,
        ray_init: dict[str, Any],
        **torchrl: Any,
    ) -> None:
        self._learner = acting(policy, env)
        self._ended = False
        self._watcher: subprocess.Popen[bytes] | None = None
        others = _descendants(os.getpid())
        _start_ray(ray_init, workers)
        try:
            with _one_line():
                super().__init__(
                    [partial(make_env, worker) for worker in range(workers)],
                    deepcopy(policy).cpu(),
                    sync=True,
                    collector_class=WorkerCollector,
                    collector_kwargs=[{"auto_register_policy_transforms": False} for _ in range(workers)],
                    remote_configs={"num_cpus": 1},
                    weight_sync_schemes={},  # weights and normalization are sent together, below
                    update_after_each_batch=True,
                    **torchrl,
                )
                self._weight_sync_initialized = True
                ready = [collector.__ray_ready__.remote() for collector in self.remote_collectors]
                if len(ray.wait(ready, num_returns=workers, timeout=_START_SECONDS)[0]) < workers:
                    raise UserError(
                        f"Ray found no CPU within {_START_SECONDS} s for each of {workers} processes "
                        "(collector.processes); it has "
                        f"{ray.cluster_resources().get('CPU', 0):.0f}"
                    )
                ray.get(ready)
            if started := _descendants(os.getpid()) - others:
                self._watcher = kill_with_this(started)  # most notice by themselves, two take a minute
        except BaseException:
            self._ended = True  # there is nothing more to shut down, and Ray would start anew to look:
            getattr(self, "_remote_collectors", []).clear()  # TorchRL's __del__, too
            ray.shutdown()
            raise

    def update_policy_weights_(self, *_: Any, **__: Any) -> None:
        """Send the workers what to act with; TorchRL calls it before each batch."""
        weights = ray.put({name: value.cpu() for name, value in self._learner.state_dict().items()})
        for collector in self.remote_collectors:
            collector.renew.remote(weights)

    def iterator(self) -> Iterator[TensorDictBase]:
        """Collect batches.

        Raises:
            UserError: If a worker has died.
        """
        return (batch.flatten(0, 1) for batch in each(super().iterator(), _one_line))  # from [processes, robots, steps]

    def state(self) -> dict[str, Any]:
        """Return the state of all workers."""
        with _one_line():
            return {"workers": self.state_dict(), "frames": self.collected_frames}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned, in a collector made from the same config."""
        with _one_line():
            self.load_state_dict(state["workers"])
        self.collected_frames = state["frames"]

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """End the workers, and Ray where it was started here; else leave the cluster."""
        if self._ended:
            return
        self._ended = True
        super().shutdown(*args, **kwargs)
        ray.shutdown()
        if self._watcher is not None:
            self._watcher.kill()
            self._watcher.communicate()


def _start_ray(arguments: dict[str, Any], workers: int) -> None:
    names = [name for name in inspect.signature(ray.init).parameters if name != "kwargs"]
    for name in arguments:
        if name not in names:
            raise UserError(f"unknown key 'collector.ray_init.{name}' of ray.init{nearest(name, names)}")
    if arguments.get("address") == "local":
        arguments = {"num_cpus": workers} | arguments
    # Signals to a terminal or a container reach Ray's processes, too, which inherit that they wait: the learner says
    # what comes of them. It keeps its own handler: Ray sets one.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        with handling([signal.SIGTERM]):
            ray.init(**arguments)
    except Exception as error:  # Ray asserts, too
        wants_token = "InvalidAuthToken" in str(error.__cause__)
        hint = " (it wants a token: set RAY_AUTH_MODE=token)" if wants_token else ""
        raise UserError(f"collector.ray_init: {' '.join(str(error).split())}{hint}") from error
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _descendants(process: int) -> set[int]:
    """Return the processes that a process has started, and theirs; none where there is no /proc."""
    try:
        children = {int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()}
    except OSError:
        return set()
    return children.union(*map(_descendants, children))


@contextlib.contextmanager
def _one_line() -> Iterator[None]:
    """Context in which whatever Ray says of a process that is gone becomes one line."""
    try:
        yield
    except RayError as error:
        if isinstance(error, RayTaskError) and isinstance(error.cause, UserError):
            raise UserError(str(error.cause)) from error
        raise UserError(f"a process that collects has ended ({str(error).splitlines()[0].rstrip('.')})") from error
