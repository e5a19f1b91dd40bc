"""Ranges that grow while a policy learns."""

import shutil

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from physai.compose import compose
from physai.config import validate
from physai.errors import UserError
from physai.training.agent import Agent
from physai.training.config import AdrConfig, TrainConfig
from physai.training.curriculum import Boundaries
from tests.training.small import SMALL, assert_same_run, forget_after, metrics, resume_here, run_here, small_config

# A boundary at which one of two robots comes near its goal moves outwards: ranges grow from the first episodes on.
EAGER = (
    *("randomization=strong", "curriculum=adr", "curriculum.results=2"),
    *("curriculum.widen_above=0.0", "curriculum.narrow_below=0.0"),
    *("env.task.max_steps=20", "env.task.tolerance=0.2"),
)


def boundaries(results=8, widen_above=0.75, narrow_below=0.25, step=0.3, sides=3):
    config = AdrConfig(
        name="adr", pinned=0.4, results=results, widen_above=widen_above, narrow_below=narrow_below, step=step
    )
    return Boundaries(config, sides)


def taken(side, successes, failures, **config):
    made = boundaries(**config)
    made.take(torch.full((successes + failures,), side), torch.arange(successes + failures) < successes)
    return made


@pytest.mark.parametrize(
    ("successes", "failures", "expected"),
    [(7, 1, 0.8), (1, 7, 0.2), (6, 2, 0.5), (2, 6, 0.5), (7, 0, 0.5), (0, 7, 0.5)],
)
def test_a_side_goes_out_or_back_or_stays_when_it_has_enough_results(successes, failures, expected):
    share = torch.full((3,), 0.5, dtype=torch.float64)
    made = taken(1, successes, failures)
    assert made.moved(share).tolist() == pytest.approx([0.5, expected, 0.5])
    judged = successes + failures >= 8
    assert made.results.tolist() == [0, 0 if judged else 7, 0]  # a buffer that has decided is empty
    assert (made.successes.sum() > 0) == (not judged and successes > 0)


def test_results_of_several_batches_count_together_and_those_on_no_boundary_do_not():
    made = boundaries()
    for _ in range(2):
        made.take(torch.tensor([0, 3, 3, 0, 2]), torch.tensor([True, True, False, False, True]))
    assert (made.results.tolist(), made.successes.tolist()) == ([4, 0, 2], [2, 0, 2])


@given(
    episodes=st.lists(st.tuples(st.integers(0, 3), st.booleans()), max_size=60),
    start=st.lists(st.floats(0, 1), min_size=3, max_size=3),
    step=st.floats(0.01, 1.0),
)
def test_no_side_goes_farther_than_a_step_or_past_its_ends_and_no_buffer_stays_full(episodes, start, step):
    made, share = boundaries(results=4, step=step), torch.tensor(start, dtype=torch.float64)
    for side, success in episodes:
        made.take(torch.tensor([side]), torch.tensor([success]))
        after = made.moved(share)
        assert ((after >= 0) & (after <= 1)).all()
        assert ((after - share).abs() <= step + 1e-12).all()
        assert (made.results < 4).all()
        assert (made.successes <= made.results).all()
        share = after


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["curriculum=ard"], ["curriculum/ard", "did you mean 'adr'"]),
        (["curriculum=adr", "curriculum.steps=0.1"], ["curriculum.steps", "curriculum.step'"]),
        (["curriculum=adr", "curriculum.step=0.0"], ["step", "greater than 0"]),
        (["curriculum=adr", "curriculum.pinned=1.1"], ["pinned", "1.1"]),
        (["curriculum=adr", "curriculum.narrow_below=0.95"], ["narrow_below 0.95 is above widen_above 0.9"]),
        (["curriculum=linear", "+curriculum.step=0.1"], ["unknown key 'curriculum.linear.step'"]),
    ],
)
def test_an_impossible_curriculum_is_one_line(overrides, words):
    with pytest.raises(UserError) as caught:
        validate(TrainConfig, compose("train", overrides))
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_a_randomization_in_which_nothing_can_grow_is_refused():
    with pytest.raises(UserError, match="nothing of randomization=none"):
        Agent.build(small_config("randomization=none", "curriculum=adr"))


@pytest.mark.slow
def test_ranges_grow_linearly_from_the_robot_as_described_to_the_whole_randomization(tmp_path):
    """A whole run, two seconds: nothing else shows that frames move ranges, and that logs have them."""
    run_here(tmp_path / "run", *SMALL, "total_frames=4096", "randomization=strong", "curriculum=linear")
    high = [float(row["curriculum/payload/high"]) for row in metrics(tmp_path / "run")]
    assert high == pytest.approx([0.125, 0.25, 0.375, 0.5])
    assert {float(row["curriculum/payload/low"]) for row in metrics(tmp_path / "run")} == {0.0}


@pytest.fixture(scope="module", params=["single", "multi_sync", "multi_async"])
def finished(request, tmp_path_factory):
    run = tmp_path_factory.mktemp("curriculum") / "run"
    run_here(run, *SMALL, *EAGER, "collector.num_envs=64", f"collector={request.param}")
    return run


@pytest.mark.slow
def test_a_run_killed_while_ranges_grow_and_resumed_ends_like_the_uninterrupted_one(finished, tmp_path):
    """Ten seconds for each way to collect: ranges travel another way in each, and a seed gives one run in all."""
    ranges = [[row[key] for key in row if key.startswith("curriculum/")] for row in metrics(finished)]
    assert ranges[0] != ranges[3] != ranges[-1]  # they grow before and after the kill
    shutil.copytree(finished, tmp_path / "run")
    forget_after(tmp_path / "run", 4096)
    resume_here(tmp_path / "run")
    assert_same_run(tmp_path / "run", finished)
