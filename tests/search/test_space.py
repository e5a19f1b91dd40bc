"""Ranges on the command line and in ``conf/search``, and the distributions that they become."""

import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from physai.compose import compose, conf_dir
from physai.config import validate
from physai.errors import UserError
from physai.search import space
from physai.search.config import SearchConfig
from physai.training.config import TrainConfig
from tests.composed import composed

READY = sorted(path.stem for path in (conf_dir() / "search").glob("*.yaml"))


def ready(*given):
    return validate(SearchConfig, compose("search", given)).search.ranges


@pytest.mark.slow
@pytest.mark.parametrize("name", READY)
def test_every_choice_and_both_ends_of_every_ready_range_fit_their_algorithm(name):
    found = space.make_space(ready(f"algo={name}"))
    assert len(found) >= 5
    for values in space.samples(found):
        validate(TrainConfig, composed(f"algo={name}", *space.overrides(values)))


def test_what_the_command_line_says_goes_before_the_ready_ranges():
    given = ["algo.epochs=3", "algo.loss.clip_epsilon=choice(0.1,0.2)", "seed=1,2"]
    found = space.ranges(ready("algo=ppo"), given)
    assert found["algo.loss.clip_epsilon"] == "choice(0.1,0.2)"
    assert found["seed"] == "1,2"
    assert "algo.epochs" not in found
    assert "algo.advantage.gamma" in found


@pytest.mark.parametrize(
    ("text", "distribution"),
    [
        ("interval(0.1,0.4)", FloatDistribution(0.1, 0.4)),
        ("tag(log,interval(1e-4,1e-2))", FloatDistribution(1e-4, 1e-2, log=True)),
        ("int(interval(2,10))", IntDistribution(2, 10)),
        ("tag(log,int(interval(2,64)))", IntDistribution(2, 64, log=True)),
        ("range(1,10,3)", IntDistribution(1, 7, step=3)),
        ("range(10,1,-3)", IntDistribution(4, 10, step=3)),
        ("range(0,1,0.25)", FloatDistribution(0.0, 0.75, step=0.25)),
        ("choice(128,512)", CategoricalDistribution([128, 512])),
        ("0.9,0.99", CategoricalDistribution([0.9, 0.99])),
        (
            "choice([64,64],[128],true,'a b')",
            CategoricalDistribution(["[64,64]", "[128]", "True", r"a\ b"]),
        ),
    ],
)
def test_a_range_becomes_a_distribution(text, distribution):
    assert space.make_space({"key": text}) == {"key": distribution}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("interval(3,1)", "`low <= high` must hold"),
        ("tag(log,interval(0,1))", "`low > 0` must hold"),
        ("tag(lgo,interval(1,2))", "the only tag of a range is log"),
        ("range(3,3)", "the range is empty"),
        ("0.1", "a range is needed"),
        ("interval(1", "is not an override"),
        ("glob(*)", "ConfigLoader"),
    ],
)
def test_a_bad_range_is_named_in_one_line(text, reason):
    with pytest.raises(UserError, match=reason) as error:
        space.make_space({"algo.epochs": text})
    assert "algo.epochs" in str(error.value)
    assert "\n" not in str(error.value)


def test_values_are_overrides_that_the_command_line_takes():
    found = space.make_space({"policy.actor.hidden_sizes": "choice([64,64],[128])", "export.formats": "choice([])"})
    config = compose("train", space.overrides(space.samples(found)[1]))
    assert config.policy.actor.hidden_sizes == [128]
    assert config.export.formats == []
