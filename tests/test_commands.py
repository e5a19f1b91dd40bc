"""The commands as a user types them: what they refuse, and in which words."""

import json
import os
import shutil
from pathlib import Path
from typing import ClassVar

import pytest
from hydra.experimental.callback import Callback
from omegaconf import OmegaConf

from physai.compose import compose
from tests.training.small import SMALL, TINY, command

ROOT = Path(__file__).parent.parent


def broken_urdf(tmp_path, old, new):
    text = (ROOT / "physai" / "robots" / "assets" / "planar_arm.urdf").read_text()
    assert old in text
    path = tmp_path.parent / f"{tmp_path.name}.urdf"
    path.write_text(text.replace(old, new, 1))
    return path


BAD_TRAINING = {
    "misspelt key": (["total_frame=5"], "unknown key 'total_frame'; did you mean 'total_frames'?"),
    "misspelt key with +": (["+total_frame=5"], "unknown key 'total_frame'; did you mean 'total_frames'?"),
    "misspelt nested key": (
        ["algo.optimizer.lrr=5"],
        "unknown key 'algo.optimizer.lrr'; did you mean 'algo.optimizer.lr'?",
    ),
    "misspelt argument with +": (
        ["+algo.loss.clip_epsilonn=1"],
        "clip_epsilonn' of physai.algorithms.FusedClipPPOLoss; did you mean",
    ),
    "key at the wrong place": (["+clip_epsilon=0.1"], "did you mean 'algo.loss.clip_epsilon'?"),
    "misspelt group": (["envs=reacher"], "unknown key 'envs'; did you mean 'env'?"),
    "unknown env": (["env=reachr"], "env/reachr: no such config; did you mean 'reacher'?"),
    "unknown target": (
        ["algo.optimizer._target_=torch.optim.Adamm"],
        "torch.optim has no 'Adamm'; did you mean 'Adam'?",
    ),
    "wrong type": (["algo.optimizer.lr=fast"], "algo.optimizer.lr: input should be a valid number"),
    "wrong type of a count": (["total_frames=many"], "total_frames: input should be a valid integer"),
    "text for a number": (["env.control_dt='0.02'"], "env.control_dt: input should be a valid number"),
    "negative size": (
        ["policy.actor.hidden_sizes=[-3]"],
        "policy.actor.hidden_sizes: input should be greater than 0",
    ),
    "a residual of nothing": (
        ["policy.actor._target_=physai.policies.ResidualActor"],
        "policy.actor: it adds to what the task suggests, and that of 'reacher' does not",
    ),
    "a policy that no robot could run": (
        ["policy.actor.in_keys=[features,physics_parameters]"],
        "policy.actor.in_keys: a policy that sees 'physics_parameters' cannot be exported",
    ),
    "zero robots": (["collector.num_envs=0"], "collector.num_envs: input should be greater than 0, got 0"),
    "negative seed": (["seed=-1"], "seed: input should be greater than or equal to 0, got -1"),
    "zero batch": (
        ["collector.frames_per_batch=0"],
        "collector.frames_per_batch: input should be greater than 0",
    ),
    "uneven batch": (
        ["collector.num_envs=256", "collector.frames_per_batch=2000"],
        "must be a multiple of collector.num_envs (256)",
    ),
    "uneven processes": (
        ["collector=multi_sync", "collector.num_envs=255"],
        "collector.num_envs (255) must be a multiple of collector.processes (2)",
    ),
    "minibatch of the buffer": (["algo.buffer.batch_size=256"], "minibatches are algo.minibatch_size"),
    "minibatch too large": (["algo.minibatch_size=5000"], "a minibatch of 5000 is larger than a batch"),
    "zero minibatch": (["algo.minibatch_size=0"], "algo.minibatch_size: input should be greater than 0, got 0"),
    "existing key with +": (["+total_frames=5"], "'total_frames' exists already: change it without the +"),
    "removed group": (["~env"], "env"),
    "clip out of range": (["algo.loss.clip_epsilon=-1"], "algo.loss.clip_epsilon: must be between 0 and 1, got -1"),
    "discount out of range": (["algo.advantage.gamma=2"], "algo.advantage.gamma: must be between 0 and 1, got 2"),
    "negative rate": (["algo.optimizer.lr=-1"], "Invalid learning rate: -1"),
    "unknown input": (
        ["policy.actor.in_keys=[observatio]"],
        "the env gives no 'observatio'; did you mean 'observation'?",
    ),
    "unreachable goals": (
        ["env.task.goal_radius=[0.3,0.9]"],
        "0.9 m is beyond the reach of 'planar_arm', 0.550 m",
    ),
    "too fast": (["env.robot.command_limit=[9,1]"], "beyond the limit of 'joint1', 2.5 rad/s"),
    "reversed range": (["randomization.payload.low=3"], "randomization.payload"),
    "a robot behind ROS": (["physics=ros"], "a policy is trained on simulated robots; this one it can drive with"),
    "unknown physics": (
        ["physics._target_=physai.physics.pybullet.PyBulletPhysic"],
        "physics._target_: physai.physics.pybullet has no 'PyBulletPhysic'; did you mean 'PyBulletPhysics'?",
    ),
    "missing URDF": (["env.robot.urdf=/nowhere.urdf"], "/nowhere.urdf: no such URDF file"),
    "unknown joint": (["env.robot.joints=[joint1,joint3]"], "no joint 'joint3'; did you mean"),
    "not an override": (["total_frames"], "not an override such as key=value"),
    "unwritable folder": (
        ["hydra.run.dir=/proc/nowhere/run"],
        "cannot create the run folder /proc/nowhere/run",
    ),
    "resume of nothing": (["resume=nowhere"], "nowhere: no run there"),
    "an interval in a sweep": (["-m", "seed=interval(0,3)"], "python -m physai.search looks through an interval"),
    "bad value in a sweep": (["-m", "seed=0,1", "algo.optimizer.lr=1e-3,-1"], "Invalid learning rate: -1"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", BAD_TRAINING)
def test_train_refuses_in_one_line_before_anything_exists(run, tmp_path, case):
    arguments, message = BAD_TRAINING[case]
    code, _, error = run("train", *arguments)
    assert code == 2
    assert message in error
    assert len(error.strip().splitlines()) == 1, error
    assert error.startswith("error: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<mass value="1.0"/>', '<mass value="heavy"/>', "link 'link1': <mass value> is 'heavy'"),
        ('<mass value="0.6"/>', '<mass value="-1"/>', "link 'link2': its mass is negative"),
        (
            '<child link="link2"/>',
            '<child link="lnik2"/>',
            "joint 'joint2': its child link 'lnik2' does not exist",
        ),
        ("</robot>", "", "not well-formed XML"),
    ],
)
def test_a_broken_urdf_names_the_part_that_is_broken(run, tmp_path, old, new, message):
    path = broken_urdf(tmp_path, old, new)
    code, _, error = run("train", f"env.robot.urdf={path}")
    assert code == 2
    assert message in error
    assert len(error.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def copied(small_run, tmp_path):
    shutil.copytree(small_run, tmp_path / "run")
    return tmp_path / "run"


def test_resume_refuses_another_config_and_names_the_difference(run, copied):
    code, _, error = run("train", "resume=run", "algo.advantage.gamma=0.5")
    assert code == 2
    assert "the run has algo.advantage.gamma=0.95, not 0.5; a resumed run keeps its config" in error
    code, output, _ = run("train", "resume=run", "algo.advantage.gamma=0.95")
    assert code == 0
    assert "complete already" in output


def test_resume_refuses_a_truncated_checkpoint(run, copied):
    (copied / "summary.json").unlink()
    last = sorted((copied / "checkpoints").glob("0*.pt"))[-1]
    last.write_bytes(last.read_bytes()[:1000])
    code, _, error = run("train", "resume=run")
    assert code == 2
    assert f"{last.name}: the checkpoint is damaged" in error


def test_resume_refuses_a_truncated_config(run, copied):
    config = copied / ".hydra" / "config.yaml"
    config.write_text(config.read_text()[:250])
    code, _, error = run("train", "resume=run")
    assert code == 2
    assert "the run's config is damaged" in error
    assert len(error.strip().splitlines()) == 1


class Heard(Callback):
    """Notes what Hydra tells its callbacks."""

    events: ClassVar[list[str]] = []

    def __getattribute__(self, name):
        if name.startswith("on_"):
            self.events.append(name)
        return super().__getattribute__(name)


@pytest.mark.slow
def test_a_run_leaves_hydras_files_and_tells_its_callbacks(run, tmp_path):
    Heard.events.clear()
    callback = f"+hydra.callbacks.heard._target_={__name__}.Heard"
    assert run("train", *TINY, "seed=3", "hydra.run.dir=here", callback)[0] == 0
    assert Heard.events == ["on_run_start", "on_job_start", "on_job_end", "on_run_end"]
    assert OmegaConf.load(tmp_path / "here/.hydra/overrides.yaml") == [*TINY, "seed=3"]
    assert OmegaConf.load(tmp_path / "here/.hydra/config.yaml").seed == 3
    hydra = OmegaConf.load(tmp_path / "here/.hydra/hydra.yaml").hydra
    assert hydra.mode == "RUN"
    assert hydra.job.name == hydra.job.config_name == "train"
    assert hydra.runtime.output_dir == str(tmp_path / "here")


@pytest.mark.slow
def test_a_second_run_does_not_overwrite_the_first(run, copied):
    before = (copied / "summary.json").read_bytes()
    code, _, error = run("train", *SMALL, "hydra.run.dir=run")
    assert code == 2
    assert "holds a run already: go on with resume=run" in error
    assert (copied / "summary.json").read_bytes() == before


def test_resume_refuses_a_run_whose_checkpoints_are_gone(run, copied):
    (copied / "summary.json").unlink()
    shutil.rmtree(copied / "checkpoints")
    before = (copied / "metrics.csv").read_bytes()
    code, _, error = run("train", "resume=run")
    assert code == 2
    assert "its checkpoints are gone" in error
    assert (copied / "metrics.csv").read_bytes() == before


@pytest.mark.slow
def test_a_second_sweep_does_not_overwrite_the_first(run, copied, tmp_path):
    shutil.copytree(copied, tmp_path / "sweep" / "0")
    code, _, error = run("train", "-m", *SMALL, "seed=0,1", "hydra.sweep.dir=sweep")
    assert code == 2
    assert "sweep holds a run already: choose another hydra.sweep.dir" in error


@pytest.mark.slow
def test_evaluate_says_how_sure_it_is_and_which_randomization_it_used(run, copied):
    code, output, _ = run("evaluate", "run=run", "episodes=50", "in_a_row=1", "randomization=strong")
    assert code == 0
    assert "95 % interval" in output
    assert "strong" in output
    result = json.loads((copied / "evaluation_strong.json").read_text())
    assert result["episodes"] == 50
    assert result["success_ci"][0] <= result["success_rate"] <= result["success_ci"][1]


def test_evaluate_drives_another_env_and_names_its_file_after_it(run, copied):
    sizes = ("episodes=20", "in_a_row=0")
    code, _, error = run("evaluate", "run=run", *sizes, "env=reacher", "env.start.spread=[0.0,0.0]")
    assert code == 0, error
    result = json.loads((copied / "evaluation_reacher_default.json").read_text())
    assert (result["env"], result["randomization"], result["episodes"]) == ("reacher", "default", 20)


@pytest.mark.parametrize("env", [[], ["env=reacher"]], ids=["the run's env", "an env"])
def test_evaluate_judges_a_policy_in_another_engine_and_names_its_file_after_it(run, copied, env):
    sizes = ("episodes=20", "in_a_row=0")
    code, _, error = run("evaluate", "run=run", *sizes, "physics=mujoco", "physics.motor=servo", *env)
    assert code == 0, error
    name = "_".join(["evaluation", *("reacher" for _ in env), "mujoco", "default"])
    result = json.loads((copied / f"{name}.json").read_text())
    assert result["physics"]["motor"] == "servo"
    assert result["episodes"] == 20


def test_an_env_that_is_chosen_stays_in_the_run_s_engine(run, copied):
    config = copied / ".hydra" / "config.yaml"
    node = OmegaConf.load(config)
    node.physics = compose("train", ["physics=mujoco"]).physics
    OmegaConf.save(node, config)
    code, _, error = run("evaluate", "run=run", "episodes=20", "in_a_row=0", "env=reacher")
    assert code == 0, error
    result = json.loads((copied / "evaluation_reacher_default.json").read_text())
    assert result["physics"]["_target_"] == "physai.physics.mujoco.MuJoCoPhysics"


@pytest.mark.parametrize(
    ("module", "arguments", "message"),
    [
        ("evaluate", ["run=nowhere"], "nowhere: no run there"),
        ("evaluate", ["run=run", "checkpoint=7"], "no checkpoint '7'; there are: best"),
        ("evaluate", ["run=run", "episodes=0"], "episodes: input should be greater than 0"),
        ("evaluate", ["run=run", "randomization=stron"], "did you mean 'strong'?"),
        ("evaluate", ["run=run", "env=kuka_reachr"], "env/kuka_reachr: no such config; did you mean 'kuka_reacher'?"),
        ("evaluate", ["run=run", "env=reacher", "env.task.tolerence=1"], "did you mean 'env.task.tolerance'?"),
        ("evaluate", ["run=run", "env=reacher", "env.task.tolerance=-1"], "task.tolerance: input should be greater"),
        (
            "evaluate",
            ["run=run", "env=kuka_reacher"],
            "has the joints ['lbr_iiwa_joint_1', 'lbr_iiwa_joint_2'], the run's policy drives ['joint1', 'joint2']",
        ),
        ("play", ["run=run", "env=kuka_reacher"], "env 'kuka_reacher' has the joints"),
        (
            "evaluate",
            ["run=run", "physics=ros", "physics.remap=[joint_states]"],
            "physics.remap: string should match pattern",
        ),
        (
            "evaluate",
            ["run=run", "physics=pybullet", "physics._target_=physai.ros.RosPhysics"],
            "env.physics: RosPhysics.__init__() missing 4 required positional arguments: 'homing_speed'",
        ),
        ("evaluate", ["run=run", "physics=mujoc"], "physics/mujoc: no such config; did you mean 'mujoco'?"),
        (
            "evaluate",
            [
                "run=run",
                "env=reacher",
                "physics=mujoco",
                "env.physics={_target_: physai.physics.pybullet.PyBulletPhysics}",
            ],
            "robots of 'reacher' come with their own",
        ),
        ("evaluate", [], "run=... is required"),
        ("play", ["run=run", "output=arm.avi"], "must end in .mp4 or .gif"),
        ("play", ["run=run", "render=windw"], "render: input should be 'video', 'human' or 'web'"),
        ("plot", ["runs=[nowhere]"], "nowhere: no run there"),
        ("export", [], "needed: run=<run folder> to export, or inspect=<policy.pt> to look at a policy"),
        ("export", ["run=run", "inspect=run/policy.pt"], "not both: run=<run folder> to export"),
        ("export", ["run=nowhere"], "nowhere: no run there"),
        ("export", ["run=run", "checkpoint=7"], "no checkpoint '7'; there are: best"),
        ("export", ["run=run", "format=tflite"], "format: input should be 'torchscript', 'onnx' or 'all'"),
        ("export", ["inspect=nowhere.pt"], "nowhere.pt: no such file"),
        ("export", ["inspect=run"], "run: not a file"),
        ("export", ["inspect=run/checkpoints/best.pt"], "best.pt: "),
        ("plot", ["runs=[]"], "runs: list should have at least 1 item"),
    ],
)
def test_the_other_commands_refuse_in_one_line_too(run, copied, module, arguments, message):
    code, _, error = run(module, *arguments)
    assert code == 2
    assert message in error
    assert len(error.strip().splitlines()) == 1, error


SHORT = ("env=reacher", "env.task.max_steps=20")  # pictures take their time


@pytest.mark.slow
@pytest.mark.parametrize(("name", "magic", "env"), [("arm.gif", b"GIF89a", SHORT), ("arm.mp4", b"ftyp", ())])
def test_play_writes_a_video(run, exported_run, tmp_path, name, magic, env):
    code, output, error = run("play", f"run={exported_run}", f"output={name}", "goals=1", *env)
    assert code == 0, error
    assert magic in (tmp_path / name).read_bytes()[:16]
    assert f"Video: {name}" in output


@pytest.mark.skipif(bool(os.environ.get("DISPLAY")), reason="there is a screen here")
def test_play_in_a_window_without_a_screen_says_so(run, copied):
    code, _, error = run("play", "run=run", "render=human")
    assert code == 2
    assert "there is no screen here" in error


def test_plot_overlays_runs(run, copied, tmp_path):
    shutil.copytree(copied, tmp_path / "again")
    code, _, _ = run("plot", "runs=[run,again]", "output=both.png")
    assert code == 0
    assert (tmp_path / "both.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize(
    "module", ["train", "search", "evaluate", "export", "play", "plot", "stress", "identify", "capsules"]
)
def test_help_shows_examples_and_every_value(run, module):
    code, output, _ = run(module, "--help")
    assert code == 0
    assert f"python -m physai.{module}" in output
    assert "== Values" in output


@pytest.mark.slow
def test_a_sweep_ends_with_a_table_of_all_runs_and_a_failure_stands_out(tmp_path):
    # a rate of 5e38 passes every check and explodes at the first update
    arguments = ["-m", *TINY, "algo.optimizer.lr=1e-3,5e38", "hydra.sweep.dir=sweep"]
    process = command("train", *arguments, cwd=tmp_path)
    output = process.communicate()[0]
    assert process.returncode == 1
    table = output[output.rindex("differs by") :]
    assert "algo.optimizer.lr=0.001" in table
    assert "failed" in table
    assert "error: sweep/1: iteration 1: the loss is not finite" in table
    assert "error: 1 of 2 runs failed" in table
    assert (tmp_path / "sweep" / "training.png").is_file()
    assert (tmp_path / "sweep" / "0" / "summary.json").is_file()


def nothing_plus_one(*_, **__):
    return None + 1


@pytest.mark.parametrize("full", ["0", "1"])
def test_an_error_within_a_part_of_ones_own_is_one_line_and_a_traceback_on_demand(run, monkeypatch, full):
    monkeypatch.setenv("HYDRA_FULL_ERROR", full)
    own = "+algo.optimizer={_target_: tests.test_commands.nothing_plus_one}"
    code, _, error = run("train", "~algo.optimizer", own, *SMALL)
    *traceback, line = error.splitlines()
    assert (code, line[:7]) == (2, "error: "), error
    assert ("    return None + 1" in traceback) == (full == "1")
