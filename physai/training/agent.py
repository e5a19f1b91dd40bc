"""The parts of a run, built from its config; and the trained part of them, read back from a file."""

import copy
import hashlib
import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Composite
from torchrl.record.loggers import TensorboardLogger

from physai.algorithms import Algorithm, Networks
from physai.collectors import FrameSource, make_collector
from physai.envs.make import TransformedRobotEnv, make_env
from physai.envs.mirror import MirrorImage
from physai.errors import UserError
from physai.physics import RandomizationConfig
from physai.policies import input_size
from physai.seeding import derive
from physai.targets import make
from physai.training.config import TrainConfig
from physai.transforms import RunningStatistics

logging.getLogger("torchrl").setLevel(logging.WARNING)  # at INFO it reports every storage that it allocates

_NETWORK = ("in_keys", "out_keys", "parameters", "state_dict")


@dataclass
class Agent:
    """What learns, and where.

    Attributes:
        env: Robots of the learner's own process: all that it collects from, or one that shows what others are like.
        statistics: Of observations; they renew the normalizer that env, collector and algorithm refer to.
        actor: The policy.
        critic: What it is judged by.
        algorithm: What changes both.
        collector: Where batches come from.
    """

    env: TransformedRobotEnv
    statistics: RunningStatistics
    actor: TensorDictModuleBase
    critic: TensorDictModuleBase
    algorithm: Algorithm
    collector: FrameSource

    @classmethod
    def build(cls, config: TrainConfig) -> "Agent":
        """Build all parts; seeds the process' random numbers, which weights, exploration and minibatches use.

        Raises:
            UserError: If a part cannot be built from its config.
        """
        if not config.env.simulated:
            raise UserError(
                "physics: a policy is trained on simulated robots; this one it can drive with "
                "python -m physai.evaluate run=<run> physics=..."
            )
        device = torch.device(config.device)
        if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
            raise UserError(f"device={config.device}: torch finds {torch.cuda.device_count()} GPUs here")
        from physai.training.earlier import load_pretrained, load_teacher  # policies, made of what is made here

        taught = {"teacher": load_teacher(config)} if "teacher" in config.algo else {}
        torch.set_num_threads(config.threads)
        torch.manual_seed(derive(config.seed, "learner"))
        memory = config.memory_size
        pinned = None if config.curriculum is None else config.curriculum.pinned
        make_robots = partial(
            make_env, config.env, config.randomization, config.normalization, memory_size=memory, pinned=pinned
        )
        env = make_robots(config.collector.envs_of_learner, derive(config.seed, "train"))
        if env.ranges is not None and not env.ranges.sides:
            raise UserError(
                f"curriculum: nothing of randomization={config.randomization.name} has a range that can grow"
            )
        actor = make_actor(config, env).to(device)
        statistics = RunningStatistics(env.normalizer, config.normalization.eps)
        if config.pretrained is not None:
            load_pretrained(config, actor, statistics)
        judged = Composite(**env.observation_spec, **env.full_action_spec, shape=env.batch_size)
        inputs = input_size(judged, config.policy.critic.get("in_keys"), "policy.critic")
        critic = make("policy.critic", config.policy.critic, needs=_NETWORK, in_features=inputs).to(device)
        algorithm = make(
            "algo",
            config.algo,
            needs=("update", "weights", "state", "set_state", "warmup_frames"),
            networks=Networks(actor, critic, env.normalizer, partial(MirrorImage, env.simulation, env.normalizer)),
            frames_per_batch=config.collector.frames_per_batch,
            **taught,
        )
        collector = make_collector(
            config.collector,
            env,
            make_robots,
            actor,
            config.total_frames,
            config.seed,
            algorithm.warmup_frames,
            device,
        )
        return cls(env, statistics, actor, critic, algorithm, collector)

    def weights_sha256(self) -> str:
        """Hash of the networks' weights and the normalization statistics."""
        digest = hashlib.sha256()
        for weights in (self.algorithm.weights(), self.statistics.state_dict()):
            for name, value in sorted(weights.items()):
                digest.update(name.encode())
                digest.update(value.cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    @property
    def on_gpu(self) -> bool:
        """Whether the networks are not where the robots are."""
        return next(self.actor.parameters()).is_cuda

    def policy(self) -> TensorDictModuleBase:
        """The actor where robots are, on the CPU."""
        return copy.deepcopy(self.actor).cpu() if self.on_gpu else self.actor

    def policy_state(self) -> dict[str, Any]:
        """What acting needs: the actor's weights and the normalization statistics."""
        return {
            "actor": {key: value.cpu().clone() for key, value in self.actor.state_dict().items()},
            "normalization": {key: value.clone() for key, value in self.statistics.state_dict().items()},
        }

    def state(self) -> dict[str, Any]:
        """Return what ``set_state`` needs to go on bit for bit."""
        return {
            **self.policy_state(),
            "algorithm": self.algorithm.state(),
            "collector": self.collector.state(),
            "random": torch.get_rng_state(),
            "random_on_gpus": torch.cuda.get_rng_state_all() if self.on_gpu else [],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what ``state`` returned, in an agent built from the same config."""
        self.algorithm.set_state(state["algorithm"])
        self.collector.set_state(state["collector"])
        self.statistics.load_state_dict(state["normalization"])
        torch.set_rng_state(state["random"])
        torch.cuda.set_rng_state_all(state["random_on_gpus"])

    def close(self) -> None:
        """Free the robots."""
        self.collector.shutdown()
        self.env.simulation.close()  # TorchRL's collector believes its env closed from the start


def make_actor(config: TrainConfig, env: TransformedRobotEnv) -> TensorDictModuleBase:
    """Build an untrained actor for an env."""
    inputs = input_size(env.observation_spec, config.policy.actor.get("in_keys"), "policy.actor")
    sizes = {"in_features": inputs, "action_size": env.action_spec.shape[-1]}
    actor = make("policy.actor", config.policy.actor, needs=(*_NETWORK, "deterministic"), **sizes)
    if getattr(actor, "memory_size", 0) != config.memory_size:  # the env is made first, from the config
        raise UserError(
            "policy.actor: how much an actor remembers is its argument memory_size, and past_actions of each joint"
        )
    if getattr(actor, "residual", False) and not env.simulation.task.module.suggests:
        raise UserError(f"policy.actor: it adds to what the task suggests, and that of '{config.env.name}' does not")
    return actor


def load_policy_state(actor: TensorDictModuleBase, statistics: RunningStatistics, state: dict[str, Any]) -> None:
    """Give an actor its weights, and an env's normalization its statistics."""
    try:
        actor.load_state_dict(state["actor"])
        statistics.load_state_dict(state["normalization"])
    except (RuntimeError, LookupError, TypeError, ValueError, AttributeError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0][:120]
        raise UserError(f"the checkpoint does not fit the run's config: {reason}") from error


def make_evaluation_env(
    config: TrainConfig, randomization: RandomizationConfig, num_envs: int, seed: int
) -> TransformedRobotEnv:
    """Build an env of its own for evaluation, with random numbers that training never uses."""
    seed = derive(seed, "evaluation")
    return make_env(config.env, randomization, config.normalization, num_envs, seed, config.memory_size)


def make_logger(config: TrainConfig, run_dir: Path) -> Any:
    """Build the TorchRL logger, and tell it the config."""
    logger = make("logger", config.logger, needs=("log_metrics", "log_hparams"), log_dir=str(run_dir))
    if not isinstance(logger, TensorboardLogger):  # which would show the config as a run of its own
        logger.log_hparams(_flat(config.model_dump(exclude={"logger", "resume", "allow"})))
    return logger


def _flat(node: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Key and value of each leaf, as they are given on the command line."""
    leaves: dict[str, Any] = {}
    for key, value in node.items():
        leaves |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return leaves
