"""Whatever stands where a ``_target_`` is wanted: it works, or one line says why not."""

import pytest
from omegaconf import OmegaConf

from physai.errors import UserError
from physai.targets import find
from physai.train import Training
from tests.composed import composed

TINY = ("collector=single", "collector.num_envs=4", "collector.frames_per_batch=64", "algo.minibatch_size=32")
MODULES = {
    "raises": "raise RuntimeError('no\\nway')",
    "exits": "import sys; sys.exit(7)",
    "broken": "x =",
    "needs": "import nothing_such",
    "kinds": "class Other:\n  def __init__(self, **_): pass\ndef fails(**_): raise KeyError('k')\nnumber = 3",
}


@pytest.fixture(autouse=True)
def modules(tmp_path, monkeypatch):
    for name, text in MODULES.items():
        (tmp_path / f"bad_{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))


NO_NAMES = ["", ".", "..", "os", "torch.", ".torch", "a b.c", "a\x00.b", "a" * 5000, "a." * 3000 + "b", 7, 3.5, True]


@pytest.mark.parametrize("name", NO_NAMES, ids=lambda name: repr(name)[:20])
def test_what_is_no_dotted_name_is_not_looked_up(name):
    with pytest.raises(ValueError, match=r"is no name such as torch\.optim\.Adam") as error:
        find(name)
    assert len(str(error.value)) < 200


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("torch.optim.Adamm", "torch.optim has no 'Adamm'; did you mean 'Adam'?"),
        ("torch.nn.Tänh", "torch.nn has no 'Tänh'"),
        ("torch.nn", "torch.nn is of type module, which makes nothing"),
        ("torch.pi", "torch.pi is of type float, which makes nothing"),
        ("nothing_such.Thing", "there is no 'nothing_such.Thing'"),
        ("bad_raises.Thing", "bad_raises cannot be imported: RuntimeError: no way"),
        ("bad_exits.Thing", "bad_exits cannot be imported: SystemExit: 7"),
        ("bad_broken.Thing", "bad_broken cannot be imported: SyntaxError: "),
        ("bad_needs.Thing", "bad_needs.Thing needs 'nothing_such', which is not installed"),
        ("bad_kinds.number", "bad_kinds.number is of type int, which makes nothing"),
    ],
)
def test_what_cannot_be_used_is_named(name, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        find(name)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


KEYS = ["env.task", "physics", "algo", "algo.loss", "algo.buffer.sampler", "algo.optimizer", "policy.actor"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bad_kinds.Other", "bad_kinds.fails", "torch.nn.Identity", "builtins.dict", 7])
@pytest.mark.parametrize("key", KEYS)
def test_a_part_of_another_kind_is_one_line(key, name):
    node = composed(*TINY)
    OmegaConf.update(node, key, {"_target_": name}, merge=False)
    with pytest.raises(UserError) as error:
        Training().check(node)
    assert "\n" not in str(error.value)
    assert key.split(".")[-1] in str(error.value) or key.split(".")[0] in str(error.value)
