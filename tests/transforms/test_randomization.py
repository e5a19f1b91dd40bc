import numpy as np
import pytest
import torch
from scipy import stats

from physai.compose import compose
from physai.config import validate
from physai.envs.make import make
from physai.errors import UserError
from physai.physics import ParameterLayout, RandomizationConfig
from physai.robots import RobotSpec
from physai.transforms import DomainRandomization
from tests import composed

NOTHING = dict.fromkeys(name for name in RandomizationConfig.model_fields if name != "name")


def config(**draws):
    return RandomizationConfig.model_validate({"name": "test", **NOTHING, **draws})


def uniform(low, high, operation="set"):
    return {"distribution": "uniform", "low": low, "high": high, "operation": operation}


def log_uniform(low, high, operation="set"):
    return {"distribution": "log_uniform", "low": low, "high": high, "operation": operation}


def normal(mean, std, operation="set"):
    return {"distribution": "normal", "mean": mean, "std": std, "operation": operation}


@pytest.fixture(scope="module")
def layout(two_joint_env):
    return ParameterLayout(RobotSpec.from_config(two_joint_env.robot))


@pytest.fixture
def make_env():
    """Make an env that is closed after the test."""
    made = []

    def make_closing(*args, **kwargs):
        made.append(make(*args, **kwargs))
        return made[-1]

    yield make_closing
    for env in made:
        env.close()


def draw(layout, rows=3000, seed=0, **draws):
    """Draws for one parameter, [rows, k], and its nominal values, [k]."""
    ((name, _),) = draws.items()
    columns = layout.columns[name]
    sampled = DomainRandomization(config(**draws), layout, rows, seed).sample(rows)
    others = torch.ones(sampled.shape[1], dtype=torch.bool)
    others[columns] = False
    assert torch.equal(sampled[:, others], layout.nominal.repeat(rows, 1)[:, others])
    return sampled[:, columns].double().numpy(), layout.nominal[columns].double().numpy()


@pytest.mark.parametrize(
    ("name", "settings", "distribution"),
    [
        (
            "link_mass",
            uniform(0.8, 1.2, "scale"),
            lambda nominal: stats.uniform(0.8 * nominal, 0.4 * nominal),
        ),
        ("link_mass", uniform(0.1, 0.3, "add"), lambda nominal: stats.uniform(nominal + 0.1, 0.2)),
        ("payload", uniform(0.5, 1.5), lambda _: stats.uniform(0.5, 1.0)),
        (
            "effort_limit",
            log_uniform(0.5, 2.0, "scale"),
            lambda nominal: stats.loguniform(0.5 * nominal, 2 * nominal),
        ),
        ("joint_damping", log_uniform(0.01, 1.0), lambda _: stats.loguniform(0.01, 1.0)),
        ("velocity_gain", normal(1.0, 0.1, "scale"), lambda nominal: stats.norm(nominal, 0.1 * nominal)),
        ("encoder_offset", normal(0.1, 0.02), lambda _: stats.norm(0.1, 0.02)),
        ("encoder_offset", normal(-0.1, 0.02, "add"), lambda _: stats.norm(-0.1, 0.02)),
        ("position_noise", uniform(0.0, 0.01), lambda _: stats.uniform(0.0, 0.01)),
        ("velocity_noise", log_uniform(0.01, 0.1), lambda _: stats.loguniform(0.01, 0.1)),
    ],
    ids=lambda value: f"{value['distribution']}-{value['operation']}" if isinstance(value, dict) else None,
)
def test_each_column_is_drawn_from_its_distribution(layout, name, settings, distribution):
    values, nominal = draw(layout, **{name: settings})
    for column in range(values.shape[1]):
        assert stats.kstest(values[:, column], distribution(nominal[column]).cdf).pvalue > 1e-3
        for other in range(column):
            assert abs(stats.spearmanr(values[:, column], values[:, other]).statistic) < 0.06


@pytest.mark.parametrize("settings", [uniform(0.5, 0.5), log_uniform(0.5, 0.5), normal(0.5, 0.0)])
def test_a_distribution_without_width_is_a_constant(layout, settings):
    values, _ = draw(layout, payload=settings)
    np.testing.assert_allclose(values, 0.5, rtol=1e-6)


def test_delays_are_whole_steps_up_to_the_longest(layout):
    values, _ = draw(layout, actuator_delay=uniform(0.0, 3.0))
    steps, counts = np.unique(values, return_counts=True)
    assert steps.tolist() == [0, 1, 2, 3]
    assert stats.chisquare(counts, np.array([1, 2, 2, 1]) / 6 * len(values)).pvalue > 1e-3
    values, _ = draw(layout, rows=20000, actuator_delay=normal(1.0, 0.5))
    assert values.min() == 0
    assert (values == values.round()).all()


def test_what_must_not_be_negative_is_not(layout):
    for name in (
        "payload",
        "joint_damping",
        "joint_friction",
        "effort_limit",
        "position_noise",
        "velocity_noise",
    ):
        assert draw(layout, **{name: normal(0.0, 1.0)})[0].min() == 0
    for name in ("link_mass", "velocity_gain"):
        assert draw(layout, **{name: normal(0.0, 1.0)})[0].min() > 0
    assert draw(layout, encoder_offset=normal(0.0, 1.0))[0].min() < -1


def test_equal_seeds_draw_equal_parameters_and_others_do_not(layout):
    payload = {"payload": uniform(0.0, 1.0)}
    first, again, other = (draw(layout, rows=50, seed=seed, **payload)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.isclose(first, other).all()


def test_successive_draws_differ(layout):
    transform = DomainRandomization(config(payload=uniform(0.0, 1.0)), layout, 50, 0)
    column = layout.columns["payload"]
    assert not torch.isclose(transform.sample(50)[:, column], transform.sample(50)[:, column]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reacher", "kuka_reacher"])
@pytest.mark.parametrize("randomization", ["none", "default", "strong"])
def test_the_engine_runs_on_the_parameters_that_the_tensordict_shows(make_env, name, randomization):
    env = make_env(name, num_envs=20, seed=3, overrides=[f"randomization={randomization}"])
    env.reset()
    td = env.rollout(5)
    shown = td["next", "physics_parameters"][:, -1]
    assert torch.equal(shown, td["physics_parameters"][:, 0])
    layout = env.simulation.layout
    for key, value in env.simulation.physics.parameters().items():
        expected = shown[:, layout.columns[key]].double().numpy()
        np.testing.assert_allclose(value, expected, rtol=1e-6, atol=1e-7, err_msg=key)
    drawn = composed.randomization(randomization)
    for key, columns in layout.columns.items():
        differs = (shown[:, columns] != layout.nominal[columns]).any()
        assert bool(differs) == (key in drawn.draws and key not in drawn.without_effect(layout)), key


@pytest.mark.parametrize("name", ["reacher", "kuka_reacher"])
def test_only_the_rows_that_are_reset_draw_anew(make_env, name):
    env = make_env(name, num_envs=12, seed=0, overrides=["randomization=strong"])
    before = env.reset()
    rows = torch.zeros(12, 1, dtype=torch.bool)
    rows[[1, 5, 11]] = True
    engine_before = env.simulation.physics.parameters()
    after = env.reset(before.clone().set("_reset", rows))
    kept = ~rows[:, 0]
    changed = before["physics_parameters"] != after["physics_parameters"]
    assert not changed[kept].any()
    link_mass = env.simulation.layout.columns["link_mass"]
    assert changed[rows[:, 0]][:, link_mass].all()
    engine = env.simulation.physics.parameters()
    for key, value in engine.items():
        np.testing.assert_array_equal(value[kept.numpy()], engine_before[key][kept.numpy()])
        expected = after["physics_parameters"][:, env.simulation.layout.columns[key]].double().numpy()
        np.testing.assert_allclose(value, expected, rtol=1e-6, atol=1e-7, err_msg=key)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("randomization.payload.low=0.9", ["payload", "0.9", "0.2"]),
        ("randomization.payload.distribution=gaussian", ["payload", "gaussian"]),
        ("randomization.payload.operation=multiply", ["payload", "operation", "multiply"]),
        ("randomization.joint_damping.low=0.0", ["joint_damping", "low"]),
        ("randomization.encoder_offset.std=-0.1", ["encoder_offset", "std", "-0.1"]),
    ],
)
def test_an_impossible_distribution_is_refused(override, words):
    with pytest.raises(UserError) as caught:
        validate(RandomizationConfig, compose("train", [override]).randomization)
    for word in words:
        assert word in str(caught.value)
