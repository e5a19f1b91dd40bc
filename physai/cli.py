"""What all commands share: overrides are checked before Hydra creates anything, and a user's error is one line."""

import contextlib
import gc
import itertools
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException

from physai.config import compose, conf_dir
from physai.errors import UserError

_SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)

Job = Callable[[DictConfig, Path], object]


def main(name: str, job: Job, check: Callable[[DictConfig], object]) -> None:
    """Run a command: ``job`` once, or once per combination of a sweep (``-m``).

    Args:
        name: Its config, ``conf/<name>.yaml``.
        job: Gets the composed config and the folder of its run.
        check: Raises a UserError if a config is bad; it sees every combination before anything is created or runs.
    """
    flags = [argument for argument in sys.argv[1:] if argument.startswith("-")]
    if set(flags) <= {"-m", "--multirun"}:
        with guard(), _imports():
            sys.argv += _check_all(name, check, overrides(), sweep=bool(flags))
    with guard():
        hydra.main(version_base="1.3", config_path=str(conf_dir().absolute()), config_name=name)(_guarded(job))()


def overrides() -> list[str]:
    """The command line without flags."""
    return [argument for argument in sys.argv[1:] if not argument.startswith("-")]


class guard:  # noqa: N801
    """Context in which what a user or a disk does wrong ends in one line and exit code 2, and Ctrl-C in 130.

    Other signals end it like Ctrl-C, so that a robot is not left moving.
    """

    def __enter__(self) -> None:
        self._before = {number: signal.signal(number, lambda number, _: sys.exit(128 + number)) for number in _SIGNALS}

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if isinstance(error, UserError):
            print(f"error: {error}", file=sys.stderr)
            sys.exit(2)
        if isinstance(error, OSError):
            print(f"error: {error.filename or 'the disk'}: {error.strerror or error}", file=sys.stderr)
            sys.exit(2)
        if isinstance(error, KeyboardInterrupt):
            sys.exit(130)


@contextlib.contextmanager
def _imports() -> Iterator[None]:
    """Context that imports heavy modules: what they make stays, and looking for garbage in it takes a fifth longer."""
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()


def _check_all(name: str, check: Callable[[DictConfig], object], given: list[str], sweep: bool) -> list[str]:
    """Check every job to come; return further overrides that pin down what Hydra would choose anew."""
    for one in _combinations(given) if sweep else [given]:
        config = compose(name, one, hydra=True)
        try:
            folder = str(config.hydra.sweep.dir if sweep else config.hydra.run.dir)
        except OmegaConfBaseException as error:
            raise UserError(" ".join(str(error).split())) from None
        with open_dict(config):
            del config["hydra"]
        check(config)
    key = "hydra.sweep.dir" if sweep else "hydra.run.dir"
    if folder == ".":
        return []
    if any(Path(folder).glob("*/.hydra" if sweep else ".hydra")):
        way_out = f"choose another {key}" if sweep else f"go on with resume={folder}, or choose another {key}"
        raise UserError(f"{folder} holds a run already: {way_out}")
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot create the run folder {folder}: {error.strerror}") from None
    if not os.access(folder, os.W_OK):
        raise UserError(f"cannot write to the run folder {folder}")
    return [f"{key}='{folder}'"]


def _combinations(given: list[str]) -> Iterator[list[str]]:
    try:
        parsed = OverridesParser.create().parse_overrides(given)
    except OverrideParseException as error:
        raise UserError(f"'{error.override}' is not an override such as key=value") from None
    choices = []
    for override in parsed:
        if override.is_sweep_override() and override.is_discrete_sweep():
            key = override.get_key_element()
            choices.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        elif not override.is_sweep_override():
            choices.append([str(override.input_line)])
    return (list(one) for one in itertools.product(*choices))


def _guarded(job: Job) -> Callable[[DictConfig], object]:
    def run(config: DictConfig) -> object:
        context = HydraConfig.get()
        folder = Path(context.runtime.output_dir)
        folder = folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder
        if context.mode is RunMode.RUN:
            with guard():
                return job(config, folder)
        try:
            print(f"\n[{context.job.num}] {context.job.override_dirname}", flush=True)
            return job(config, folder)
        except Exception as error:
            # A sweep goes on without the job that failed; its report names it.
            with contextlib.suppress(OSError):
                (folder / "error.txt").write_text(f"{error}\n\n{traceback.format_exc()}")
            print(f"error: {error}", file=sys.stderr)
            return None

    return run
