"""Run folders that try to run code, or to reach out of themselves; each in another way.

What would run leaves a mark: the file ``mark`` beside the run folder.
"""

import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

EVIL = """
from pathlib import Path
Path({mark!r}).touch()
def touch(*args, **kwargs): Path({mark!r}).touch()
class Thing:
    simulated = True
    def __init__(self, *args, **kwargs): touch()
"""

Edit = Callable[[dict[str, Any], Path], None]


class Pickled:
    """Runs a command where it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def plant(folder: Path) -> None:
    """Put what a run folder could bring along beside it: a module, a hub repository, pickles."""
    mark = str(folder / "mark")
    for name in ("evil.py", "hubconf.py"):
        (folder / name).write_text(EVIL.format(mark=mark))
    content = pickle.dumps(Pickled(f"touch {mark}"))
    for name in ("evil.pkl", "evil.npy"):
        (folder / name).write_bytes(content)
    (folder / "evil.pth").write_text("import evil\n")


def task(target: str, **arguments: Any) -> Edit:
    """What is made first, whatever the command."""

    def edit(config, folder):
        filled = {key: _fill(value, folder) for key, value in arguments.items()}
        config["env"]["task"] = {"_target_": target, **filled}

    return edit


def at(key: str, value: Any) -> Edit:
    def edit(config, folder):
        node, *rest = config, *key.split(".")
        for part in rest[:-1]:
            node = node.setdefault(part, {})
        node[rest[-1]] = _fill(value, folder)

    return edit


def _fill(value: Any, folder: Path) -> Any:
    if isinstance(value, str):
        return value.replace("FOLDER", str(folder))
    if isinstance(value, list):
        return [_fill(one, folder) for one in value]
    if isinstance(value, dict):
        return {key: _fill(one, folder) for key, one in value.items()}
    return value


def text(old: str, new: str) -> Edit:
    """Change the file itself."""

    def edit(config, folder):
        path = folder / "run" / ".hydra" / "config.yaml"
        content = OmegaConf.to_yaml(OmegaConf.create(config))
        assert old in content
        path.write_text(content.replace(old, _fill(new, folder), 1))
        config.clear()

    return edit


def overrides(*lines: str) -> Edit:
    def edit(config, folder):
        path = folder / "run" / ".hydra" / "overrides.yaml"
        path.write_text(OmegaConf.to_yaml(OmegaConf.create([_fill(line, folder) for line in lines])))

    return edit


def checkpoint(name: str) -> Edit:
    """A checkpoint with a pickle that runs a command, as ``torch.load`` reads it without ``weights_only``."""

    def edit(config, folder):
        path = max((folder / "run" / "checkpoints").glob(name))
        torch.save({"format": 2}, path)
        with zipfile.ZipFile(path) as archive:
            members = {one: archive.read(one) for one in archive.namelist()}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for one, content in members.items():
                evil = pickle.dumps({"format": 2, "frames": Pickled(f"touch {folder / 'mark'}")}, protocol=2)
                archive.writestr(one, evil if one.endswith("data.pkl") else content)

    return edit


def link(name: str) -> Edit:
    """A link out of the run folder; a write through it leaves a mark."""

    def edit(config, folder):
        path = folder / "run" / name
        if path.exists():
            path.rename(folder / "moved")
        path.symlink_to(folder / "mark")

    return edit


_TOUCH = ["touch", "FOLDER/mark"]
_THING = {"_target_": "evil.Thing"}
_SAC_BUFFER = {
    "_target_": "torchrl.data.TensorDictReplayBuffer",
    "storage": {"_target_": "torchrl.data.LazyTensorStorage", "max_size": 1024},
    "batch_size": 1024,
}

EVALUATE: dict[str, Edit] = {
    # Whatever is installed
    "a repository of models": task("torch.hub.load", repo_or_dir="FOLDER", model="touch", source="local"),
    "a pickle by pandas": task("pandas.read_pickle", filepath_or_buffer="FOLDER/evil.pkl"),
    "a pickle by joblib": task("joblib.load", filename="FOLDER/evil.pkl"),
    "a pickle by NumPy": task("numpy.load", file="FOLDER/evil.npy", allow_pickle=True),
    "a pickle by torch": task("torch.load", f="FOLDER/evil.pkl", weights_only=False),
    "a pickle by another path": task("physai.training.checkpoint.torch.load", f="FOLDER/evil.pkl", weights_only=False),
    "a shell": task("os.system", command="touch FOLDER/mark"),
    "a process": task("subprocess.run", args=_TOUCH),
    "a process without result": task("subprocess.Popen", args=_TOUCH),
    "a file of code": task("runpy.run_path", path_name="FOLDER/evil.py"),
    "an import": task("importlib.import_module", name="evil"),
    "a name that is looked up": task("pkgutil.resolve_name", name="evil:touch"),
    "a name that pydoc looks up": task("pydoc.locate", path="evil.touch"),
    "code that is timed": task("timeit.timeit", stmt="__import__('evil')"),
    "code that is profiled": task("cProfile.run", statement="__import__('evil')"),
    "positional arguments": at("env.task", {"_target_": "builtins.exec", "_args_": ["import evil"]}),
    "a folder of sites": task("site.addsitedir", sitedir="FOLDER"),
    "logging": task("logging.config.dictConfig", config={"version": 1, "filters": {"f": {"()": "evil.touch"}}}),
    "YAML with objects": task("yaml.unsafe_load", stream="!!python/object/apply:os.system ['touch FOLDER/mark']"),
    # Whatever a library of ours leads to
    "Hydra's lookup": task("hydra.utils.get_method", path="evil.touch"),
    "Hydra's own call": task("hydra.utils.instantiate", config=_THING),
    "a module of physai": task("physai.training.run.subprocess.run", args=_TOUCH),
    "a module of a part of physai": task("physai.policies.networks.importlib.import_module", name="evil"),
    "a module of a part of torch": task("torch.nn.modules.module.torch.load", f="FOLDER/evil.pkl", weights_only=False),
    "a module of an optimizer": task(
        "torch.optim.optimizer.torch.hub.load", repo_or_dir="FOLDER", model="touch", source="local"
    ),
    "a function of a part of torch": task("torch.nn.init.torch.load", f="FOLDER/evil.pkl", weights_only=False),
    "a Gymnasium env by its module": task("gymnasium.make", id="evil:Env-v0"),
    "a TorchRL env by its module": task("torchrl.envs.GymEnv", env_name="evil:Env-v0"),
    "an env of ours with overrides": task(
        "physai.envs.gym_env.RobotGymEnv", env="reacher", overrides=["physics._target_=evil.Thing"]
    ),
    "configs of ours from a package": task(
        "physai.compose.compose", name="train", overrides=["hydra.searchpath=[pkg://evil]"]
    ),
    "a part that drives a robot": at("physics._target_", "physai.ros.RosPhysics"),
    # Its own module
    "a module beside the run": task("evil.Thing"),
    "physics": at("physics", _THING),
    "an env's physics": at("env.physics", _THING),
    "a loss": at("algo.loss", {**_THING, "_partial_": True}),
    "a logger": at("logger", _THING),
    "a part of a part": at("algo.buffer.sampler", _THING),
    "a part in a list": at("algo.buffer.transform", [_THING]),
    "a key that nobody knows": at("extra.deep", [{"down": _THING}]),
    "the hydra node": at("hydra.callbacks.evil", _THING),
    "a name in pieces": at("env.task", {"_target_": "${env.task.a}.${env.task.b}", "a": "evil", "b": "Thing"}),
    "a name in an interpolation": at("env.task._target_", "${oc.decode:evil.Thing}"),
    "a node in an interpolation": at("env.task", "${oc.create:{_target_:evil.Thing}}"),
    "an interpolation that is resolved later": at("env.task._target_", "\\${oc.decode:evil.Thing}"),
    "an activation": at("policy.actor.activation", "evil.Thing"),
    "a URDF in a package": at("env.robot.urdf", "package://evil/arm.urdf"),
    "a permission of its own": lambda config, folder: config.update(
        allow=["evil"], env=config["env"] | {"task": _THING}
    ),
    "YAML that makes objects": text("seed: 0", "seed: !!python/object/apply:os.system ['touch FOLDER/mark']"),
    "an alias": text("seed: 0", "seed: &a 0\nlater: *a"),
    "no name but a number": at("env.task._target_", 7),
    "no name but a list": at("env.task._target_", ["evil", "Thing"]),
    "no name at all": at("env.task._target_", ""),
    "a name of dots": at("env.task._target_", ".."),
    "a name that ends in a dot": at("env.task._target_", "evil."),
    "a module's name": at("env.task._target_", "evil"),
    "a name of a hundred thousand parts": at("env.task._target_", "evil" + ".evil" * 100_000),
    "a name that commands the terminal": at("env.task._target_", "evil.\x1b]0;owned\x07\nThing"),
    # Its files
    "a pickle for the best policy": checkpoint("best.pt"),
    "the environment's secrets": at("logger.exp_name", "${oc.env:HOME}"),
    "a file of the disk": at("extra", "${oc.decode:${oc.env:HOME}}"),
    "a name that is a path": at("randomization.name", "/../../mark"),
}
"""What ``evaluate``, ``export`` and ``play`` meet."""

RESUME: dict[str, Edit] = {
    "a pickle for the last checkpoint": checkpoint("0*.pt"),
    "configs from a package": overrides("hydra.searchpath=[pkg://evil]"),
    "configs from another folder": overrides("hydra.searchpath=[file://FOLDER]"),
    "an override": overrides("env.task._target_=evil.Thing"),
    "an override that is new": overrides("+algo.buffer.extra._target_=evil.Thing"),
    "an override that is no text": overrides("seed=0", "{}"),
    "Ray of somebody else": at("collector.ray_init", {"address": "ray://203.0.113.1:10001"}),
    "Ray with packages": at("collector.ray_init", {"runtime_env": {"py_modules": ["FOLDER/evil.py"]}}),
    "Ray behind a buffer": at(
        "algo.buffer",
        {**_SAC_BUFFER, "service_backend": "ray", "service_backend_options": {"ray_init_config": {"address": "auto"}}},
    ),
    "a buffer on a server": at(
        "algo.buffer.storage", {"_target_": "torchrl.data.StoreStorage", "max_size": 9, "host": "203.0.113.1"}
    ),
    "a buffer on the disk": at(
        "algo.buffer.storage",
        {"_target_": "torchrl.data.LazyMemmapStorage", "max_size": 1024, "scratch_dir": "FOLDER/mark"},
    ),
    "a server that hears of the run": at(
        "logger",
        {"_target_": "physai.training.mlflow.MLFlowLogger", "exp_name": "e", "tracking_uri": "http://203.0.113.1"},
    ),
    "a log elsewhere": at("logger.exp_name", "FOLDER/mark"),
    "a link for a log": link("episodes.csv"),
    "a link for a file that is made": link("summary.json"),
    "a link for a folder": link("tensorboard"),
    "a link where a file is written first": link("checkpoints/.best.pt.tmp"),
}
"""What ``train resume=`` meets, beside all of these."""

PLOT: dict[str, Edit] = {
    "a secret in the legend": at("env.name", "${oc.env:HOME}"),
    "overrides that are no texts": overrides("{}"),
    "a link for the picture": link("training.png"),
    "YAML that makes objects": text("seed: 0", "seed: !!python/object/apply:os.system ['touch FOLDER/mark']"),
}
"""What ``plot`` meets."""


def edit(run: Path, change: Edit) -> None:
    """Change the config of a run folder."""
    path = run / ".hydra" / "config.yaml"
    config = OmegaConf.to_container(OmegaConf.load(path))
    change(config, run.parent.resolve())
    if config:
        path.write_text(OmegaConf.to_yaml(OmegaConf.create(config, flags={"allow_objects": True})))
