"""What all commands share: overrides are checked before Hydra creates anything, and a user's error is one line."""

import contextlib
import ctypes
import gc
import importlib.util
import itertools
import os
import select
import shutil
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import hydra
from hydra._internal.callbacks import Callbacks
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import run_job
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, read_write
from omegaconf.errors import OmegaConfBaseException

from physai.compose import compose, conf_dir, initialized, jobs_at_once, parse, set_plugin_defaults
from physai.errors import UserError
from physai.processes import end_with, handling

_SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)

Job = Callable[[DictConfig, Path], object]


def main(name: str, job: Job, check: Callable[[DictConfig], object], given: Sequence[str] | None = None) -> None:
    """Run a command: ``job`` once, or once per combination of a sweep (``-m``).

    Args:
        name: Its config, ``conf/<name>.yaml``.
        job: Gets the composed config and the folder of its run.
        check: Raises a UserError if a config is bad; it sees every combination before anything is created or runs.
        given: Overrides; None takes those of the command line.
    """
    flags = [argument for argument in sys.argv[1:] if argument.startswith("-")]
    with guard():
        if any(flag.startswith("--e") for flag in flags):  # argparse takes the beginning of a flag for the flag
            raise UserError(
                "--experimental-rerun reads a pickle, which may run anything; resume=<run> goes on with a run"
            )
    if not set(flags) <= {"-m", "--multirun"}:  # --help, --info and such: Hydra's own
        _leave_to_hydra(name, job)
        return
    with guard(), _imports():
        given = overrides() if given is None else list(given)
        config, pinned = _check_all(name, check, given, sweep=bool(flags))
    if flags or config.hydra.mode is not None:
        sys.argv += pinned
        _leave_to_hydra(name, job)
        return

    def run(node: DictConfig) -> None:
        with guard():  # within Hydra, which would say more about an error
            job(node, _begin(node))

    # Like Hydra's main, but with the config that was checked: Hydra would compose it twice more.
    with read_write(config.hydra):
        config.hydra.mode = RunMode.RUN
    callbacks = Callbacks(config)
    with guard(), initialized(name) as loader:
        callbacks.on_run_start(config=config, config_name=name)
        returned = run_job(run, config, "hydra.run.dir", None, HydraContext(loader, callbacks))
        callbacks.on_run_end(config=config, config_name=name, job_return=returned)
        returned.return_value  # noqa: B018  # raises what the job has raised


def _leave_to_hydra(name: str, job: Job) -> None:
    set_plugin_defaults()
    with guard():
        hydra.main(version_base="1.3", config_path=str(conf_dir().absolute()), config_name=name)(_of_sweep(job))()


def overrides() -> list[str]:
    """The command line without flags."""
    return [argument for argument in sys.argv[1:] if not argument.startswith("-")]


@contextlib.contextmanager
def guard() -> Iterator[None]:
    """Context in which what a user or a disk does wrong ends in one line and exit code 2, and Ctrl-C in 130.

    With ``HYDRA_FULL_ERROR=1`` the traceback comes before the line. Other signals end it like Ctrl-C, so that a robot
    is not left moving.
    """
    # One that is ignored already stays so: that is what nohup asks for.
    heard = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    stack = contextlib.ExitStack()
    try:
        with handling(heard, partial(_end, stack)), stack:
            yield
    except KeyboardInterrupt:
        sys.exit(130)
    except (UserError, OSError, ImportError) as error:
        if isinstance(error, BrokenPipeError) and _nobody_reads():
            sys.exit(128 + signal.SIGPIPE)
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            traceback.print_exception(error)
        line = str(error)
        if isinstance(error, OSError):
            line = f"{error.filename or 'the disk'}: {error.strerror or error}"
        elif isinstance(error, ImportError):  # of what is half installed: TorchRL imports each simulator that it finds
            line = " ".join(line.split())
        print(f"error: {printable(line)}", file=sys.stderr)
        sys.exit(2)


def _end(stack: contextlib.ExitStack, number: int, _: object) -> None:
    """End this process for a signal; once more if it still runs a second later: what is imported may catch it."""
    error = sys.exception()
    while error is not None and not isinstance(error, SystemExit):
        error = error.__context__
    if error is not None:  # it is ending
        return
    again = threading.Timer(1.0, signal.pthread_kill, (threading.get_ident(), number))
    again.daemon = True
    again.start()
    stack.callback(again.cancel)
    sys.exit(128 + number)


def _nobody_reads() -> bool:
    """Whether the output's reader has gone, as head does after ten lines; what is left of the output is dropped then.

    A shell stops other programs by SIGPIPE then, which Python ignores.
    """
    poll = select.poll()
    poll.register(1, 0)
    gone = any(event & select.POLLERR for _, event in poll.poll(0))
    if gone:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return gone


def printable(text: str) -> str:
    """Text as one line that a terminal shows and does not obey; names in it may be from a file of anyone's."""
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


@contextlib.contextmanager
def _imports() -> Iterator[None]:
    """Context that imports heavy modules: what they make stays, and looking for garbage in it takes a fifth longer."""
    threading.Thread(target=_map_torch).start()
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()


def _map_torch() -> None:
    """Map PyTorch's largest library: 0.3 s without need of the interpreter, which can compose a config meanwhile."""
    torch = importlib.util.find_spec("torch")
    for library in Path(torch.origin).parent.glob("lib/libtorch_cpu.*") if torch and torch.origin else ():
        with contextlib.suppress(OSError):  # then importing PyTorch will say it
            ctypes.CDLL(str(library))


def _check_all(
    name: str, check: Callable[[DictConfig], object], given: list[str], sweep: bool
) -> tuple[DictConfig, list[str]]:
    """Check every job to come.

    Returns:
        The config of a single run, or what is common to a sweep's; and further overrides that pin down what Hydra
        would choose anew.
    """
    key = "hydra.sweep.dir" if sweep else "hydra.run.dir"
    fixed = [str(one.input_line) for one in parse(given) if not (sweep and one.is_sweep_override())]
    whole = compose(name, fixed, hydra=True)
    try:
        folder = str(OmegaConf.select(whole, key))
    except OmegaConfBaseException as error:
        raise UserError(" ".join(str(error).split())) from error
    launcher = whole.hydra.launcher._target_
    if sweep and launcher.endswith(".SlurmLauncher") and shutil.which("srun") is None:
        raise UserError(
            "hydra/launcher=submitit_slurm: there is no srun here, so this is no computer of a SLURM cluster"
        )
    with _shown(list(_combinations(given))) if sweep else contextlib.nullcontext([given]) as combinations:
        for one in combinations:
            config = compose(name, one, hydra=True) if sweep else whole
            if sweep and launcher.endswith(".RayLauncher") and OmegaConf.select(config, "collector.ray_init"):
                raise UserError("hydra/launcher=ray: a job of Ray's starts no other Ray: choose another collector")
            check(OmegaConf.masked_copy(config, [key for key in config if key != "hydra"]))
    with read_write(whole.hydra):
        OmegaConf.update(whole, key, folder)
    if folder == ".":
        return whole, []
    if any(Path(folder).glob("*/.hydra" if sweep else ".hydra")):
        way_out = f"choose another {key}" if sweep else f"go on with resume={folder}, or choose another {key}"
        raise UserError(f"{folder} holds a run already: {way_out}")
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot create the run folder {folder}: {error.strerror}") from error
    if not os.access(folder, os.W_OK):
        raise UserError(f"cannot write to the run folder {folder}")
    pinned = [f"{key}='{folder}'"]
    if sweep and OmegaConf.select(whole, "hydra.sweeper.max_batch_size", default=0) is None:
        if launcher.endswith(".LocalLauncher"):  # submitit would start all jobs at once
            pinned.append(f"hydra.sweeper.max_batch_size={jobs_at_once(whole)}")
        elif launcher.endswith(".BasicLauncher"):  # Hydra would compose all jobs once more before it starts the first
            pinned.append("hydra.sweeper.max_batch_size=1")
    return whole, pinned


@contextlib.contextmanager
def _shown(combinations: list[list[str]]) -> Iterator[Iterable[list[str]]]:
    """Context that shows on a terminal how far the check of a sweep is."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(
        console=Console(stderr=True),
        auto_refresh=False,  # it would take a thread for that, while the check forks
        redirect_stdout=False,
        redirect_stderr=False,
        transient=True,
        disable=not sys.stderr.isatty(),
    ) as bar:
        yield bar.track(combinations, description=f"checking {len(combinations)} jobs")


def _combinations(given: list[str]) -> Iterable[list[str]]:
    """Every job of a sweep."""
    choices = []
    for override in parse(given):
        if not override.is_sweep_override():
            choices.append([str(override.input_line)])
        elif override.is_discrete_sweep():
            key = override.get_key_element()
            choices.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        else:
            raise UserError(f"'{override.input_line}': python -m physai.search looks through an interval; -m does not")
    return (list(one) for one in itertools.product(*choices))


def _begin(config: DictConfig) -> Path:
    """Make this process ready for a job; return the folder of its run."""
    for library in ("OMP", "MKL", "OPENBLAS"):  # for what this process, or one of the job's, loads from here on
        os.environ[f"{library}_NUM_THREADS"] = str(config.get("threads") or 1)
    folder = Path(HydraConfig.get().runtime.output_dir)
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def _of_sweep(job: Job) -> Callable[[DictConfig], None]:
    starter, host = os.getpid(), socket.gethostname()

    def run(config: DictConfig) -> None:
        context, folder = HydraConfig.get(), _begin(config)
        print(f"\n[{context.job.num}] {context.job.override_dirname}", flush=True)
        here = (os.getpid(), socket.gethostname()) == (starter, host)
        if not here and socket.gethostname() == host and sys.platform == "linux" and "SLURM_JOB_ID" not in os.environ:
            end_with(starter)
        try:
            with contextlib.nullcontext() if here else _output_to(folder / "output.txt"):
                job(config, folder)
        except Exception as error:
            # A sweep goes on without the job that failed; its report names it.
            with contextlib.suppress(OSError):
                (folder / "error.txt").write_text(f"{error}\n\n{traceback.format_exc()}")
            print(f"error: [{context.job.num}] {error}", file=sys.stderr)

    return run


@contextlib.contextmanager
def _output_to(path: Path) -> Iterator[None]:
    """Context that keeps apart what jobs print that run at the same time."""
    with open(path, "w", buffering=1) as file, contextlib.redirect_stdout(file):
        yield
