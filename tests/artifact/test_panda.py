"""A real arm with seven joints, from training to a file that holds what keeps it from touching itself."""

import json

import numpy as np
import pytest

from physai.deploy import load_policy

pytestmark = pytest.mark.slow


def test_a_panda_reaches_goals_in_space_and_passes_the_whole_gate(panda_run):
    summary = json.loads((panda_run / "summary.json").read_text())
    assert summary["success_rate"] > 0.95
    metadata = load_policy(panda_run / "policy.pt").metadata
    assert (metadata.goal.labels, metadata.goal.frame, metadata.goal.unit) == (("x", "y", "z"), "panda_link0", "m")
    assert len(metadata.joints) == 7
    assert (panda_run / "policy.onnx").is_file()


def test_its_file_holds_its_capsules_and_the_floor(panda_run, env_config):
    from physai.robots import RobotSpec

    model = load_policy(panda_run / "policy.pt").metadata.collision
    spec = RobotSpec.from_config(env_config("panda_reach").robot)
    assert model.floor == 0.0
    q = spec.sample(20, np.random.default_rng(0))
    np.testing.assert_allclose(model.distance(q), spec.collision.within(floor=0.0).distance(q), atol=1e-12)
    assert ("panda_link7", "floor") in model.names
