"""What a run shows while it trains: the episodes of its evaluations, and the same results as unseen."""

import urllib.error
import urllib.request

import numpy as np
import pytest
import torch

from physai.errors import UserError
from physai.physics import RandomizationConfig
from physai.training.agent import Agent, make_evaluation_env
from physai.training.evaluation import WATCHED, Recording, evaluate
from physai.web import serve
from physai.web.training import TrainingPage
from tests.training.small import small_config
from tests.waiting import wait_for
from tests.web.test_play import picture

MOVED = 200  # pixels at least that change where an arm turns


def test_watching_changes_no_result_and_shows_the_first_robots():
    config = small_config("env.task.max_steps=20")
    agent, seen = Agent.build(config), []
    env = make_evaluation_env(config, RandomizationConfig.none(), 16, 0)
    unseen = evaluate(agent.policy(), env, 32, 0)
    watched = evaluate(agent.policy(), env, 32, 0, seen.append)
    env.close()
    agent.close()
    assert torch.equal(watched.episode_return, unseen.episode_return)
    (recording,) = seen  # of two rounds the first
    assert recording.joint_position.shape == (20, WATCHED, 2)
    assert recording.goal.shape == (WATCHED, 2)
    assert (recording.success == unseen.success[:WATCHED].numpy()).all()


@pytest.mark.slow
def test_episodes_that_are_handed_over_move_the_arms_on_the_page_until_training_ends(new_page, reacher):
    """Ten seconds for a page in a process of its own."""
    shown = TrainingPage(reacher, "127.0.0.1", 0)
    page = new_page(800, 520)
    page.goto(shown.address)
    page.get_by_text("The first evaluation is still to come.").wait_for()
    wait_for(lambda: (picture(page) == picture(page)).all(), 60.0, "a picture that stands still")
    turning = np.linspace(0.0, 3.0, 200)[:, np.newaxis, np.newaxis] * np.ones((1, WATCHED, 2))
    shown.show(50_000, Recording(turning, np.full((WATCHED, 2), 0.3), np.arange(WATCHED) < 3))
    page.get_by_text("After 50,000 frames: 3 of these 8 episodes succeed.").wait_for()
    first = picture(page)
    wait_for(lambda: (picture(page) != first).any(axis=2).sum() > MOVED, 60.0, "another picture of the arms")
    page.close()
    shown.close()
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(shown.address)


@pytest.mark.slow
def test_a_page_that_cannot_be_served_stops_a_run_before_it_begins(reacher):
    with (
        serve("127.0.0.1", 0, "first", 1.0) as server,
        pytest.raises(UserError, match="Address already in use"),
    ):
        TrainingPage(reacher, "127.0.0.1", server.get_port())
