"""Stress tests of a policy that has been trained."""

import json
import shutil

import numpy as np
import pytest

from physai.compose import compose
from physai.errors import UserError
from physai.physics import RandomizationConfig
from physai.stress.__main__ import _check
from physai.stress.axes import Axis
from physai.stress.run import StressTest
from physai.stress.trial import Trial
from physai.training.run import TrainedPolicy, load_config
from tests.stress.test_axes import settings
from tests.training.small import command

pytestmark = pytest.mark.slow  # a policy is trained for them


def in_a_hurry(run, **others):
    """The policy of a run, with episodes of 2 s."""
    env = load_config(run).env
    task = env.task | {"max_steps": 100}
    return TrainedPolicy(run, "best", env=env.model_copy(update={"task": task, **others}))


def axes(policy, *names):
    return [Axis.make(name, settings().axes, policy.config.env) for name in names]


def test_a_cliff_that_is_planted_in_a_parameter_is_found_within_a_cell_and_by_bisection(exported_run):
    policy = in_a_hurry(exported_run, physics={"_target_": "tests.stress.planted.Cliff"})
    mass, tolerance = axes(policy, "link_mass", "tolerance")
    with StressTest(policy, 20, seed=0) as test:
        found = test.map(mass, tolerance, 5)
        breaks = test.breaks([mass])["link_mass"]
    stands = found.success[-1] < 10  # at the widest tolerance
    assert stands.tolist() == (found.x_values > 2.0).tolist()
    assert 0 < stands.sum() < 5
    assert breaks["success"][0] is None
    assert 1.7 < breaks["success"][1] <= 2.0


def test_every_cell_has_the_same_robots_goals_and_starts_whatever_came_before_it(exported_run):
    policy = in_a_hurry(exported_run)
    delay, noise, speed = axes(policy, "actuator_delay", "position_noise", "speed")
    trial = Trial(policy, 25, seed=4)
    setting = [(delay, 6.0), (noise, 0.02)]
    first = trial.count(setting, policy.randomization)
    for other in ([(delay, 0.0), (noise, 0.05)], [(speed, 0.5)]):
        trial.count(other, policy.randomization)
    assert trial.count(setting, policy.randomization) == first
    trial.close()


def test_a_tighter_tolerance_is_asked_for_without_the_policy_seeing_it(exported_run):
    policy = in_a_hurry(exported_run)
    (tolerance,) = axes(policy, "tolerance")
    trial = Trial(policy, 50, seed=4)
    counts = [trial.count([(tolerance, value)], RandomizationConfig.none()).success for value in (0.1, 1.0, 2.0)]
    trial.close()
    assert counts[0] < counts[1] <= counts[2]


def test_the_command_draws_a_map_of_several_runs_and_writes_counts_and_intervals(exported_run, tmp_path):
    runs = [tmp_path / "one", tmp_path / "other"]
    for run in runs:
        run.mkdir()
        for part in ("checkpoints", ".hydra"):
            shutil.copytree(exported_run / part, run / part)
    process = command(
        "stress",
        f"run=[{runs[0]},{runs[1]}]",
        *("x=velocity_gain", "grid=2", "episodes=10", "env=reacher", "env.task.max_steps=40"),
        *("axes.actuator_delay.range=[0,1]", "output=map.png"),
        cwd=tmp_path,
    )
    output = process.communicate()[0]
    assert process.returncode == 0, output
    assert "where less than 95 % work" in " ".join(output.split())  # a long title is wrapped
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    first, second = (json.loads((run / "stress_velocity_gain_actuator_delay.json").read_text()) for run in runs)
    assert first["success"] == second["success"]  # they are one policy
    assert first["breaks"] == second["breaks"]
    assert first["x"]["trained"] == [0.7, 1.0]
    counts, intervals = (np.array(first["success"][key]) for key in ("count", "ci"))
    assert counts.shape == (2, 2)
    assert (intervals[..., 0] <= counts / 10).all()
    assert (counts / 10 <= intervals[..., 1]).all()
    assert {"link_mass", "speed"} <= set(first["breaks"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["x=link_mas"], "there is no axis 'link_mas'; did you mean 'link_mass'?"),
        (["x=payload", "y=payload"], "x and y are both 'payload'"),
        (["output=map.pdf"], "output: 'map.pdf' must end in .png"),
        (["grid=1"], "grid: input should be greater than or equal to 2, got 1"),
        (["physics=ros"], "physics: only simulated robots can be given other parameters"),
        (["run=[nowhere]"], "nowhere: no run there"),
    ],
)
def test_what_the_command_cannot_do_is_said_before_anything_happens(exported_run, arguments, said):
    with pytest.raises(UserError) as error:
        _check(compose("stress", [f"run={exported_run}", *arguments]))
    assert said in str(error.value)
