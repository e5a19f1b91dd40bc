from physai.deploy import load_policy


def test_loads(exported_run):
    assert load_policy(exported_run / "policy.pt").golden_error == 0
