"""Random limits and timeouts of a controller."""

import dataclasses

from physai.deploy import ControllerConfig


def random_config(rng):
    usual = rng.random() < 0.5
    fastest = 0.3 if usual else rng.choice((0.05, 0.3, 1.0))
    return ControllerConfig(
        max_velocity=fastest,
        limit_margin=0.165 if fastest == 1.0 else 0.1,
        max_acceleration=2.0 if usual else rng.choice((0.5, 2.0, 20.0)),
        recovery_states=5 if usual else rng.choice((2, 5, 9)),
        allow_velocity_estimate=rng.random() < 0.5,
        unreachable_goal=rng.choice(("reject", "project")),
        resume_timeout=1.0 if usual else rng.choice((0.3, 1.0, 3.0)),
        following_error=0.3 if usual else rng.choice((0.1, 0.3, 1.0)),
        progress_timeout=rng.choice((1.0, 2.0, 10.0)),
        effort_time=rng.choice((0.1, 0.5)),
        max_lead=0.25 if usual else rng.choice((0.01, 0.05, 0.25)),
    )


def other_config(rng):
    """One that differs in what usually stays, too."""
    return dataclasses.replace(
        random_config(rng),
        state_timeout=rng.choice((0.05, 0.07, 0.1)),
        jump_factor=rng.choice((1.5, 3.0)),
        limit_margin=rng.choice((0.165, 0.2)),
        limit_velocity=rng.choice((0.02, 0.05, 1.0)),
        limit_fault=rng.choice((0.16, 0.2)),
        reached_hysteresis=rng.choice((1.0, 1.5, 3.0)),
        policy_failures=rng.choice((1, 3, 5)),
        resume_timeout=rng.choice((0.15, 1.0, 10.0)),
        following_error=rng.choice((0.05, 0.3, 0.5, 100.0)),
        following_window=rng.choice((0.1, 0.2, 0.3, 0.5)),
        velocity_error=rng.choice((0.1, 0.25, 1.0)),
        progress_timeout=rng.choice((0.5, 1.5, 10.0)),
        effort_time=rng.choice((0.0, 0.04, 0.5)),
    )
