"""A student against a teacher whose opinion is known."""

import io

import pytest
import torch
from hydra.utils import instantiate
from tensordict import TensorDict

from physai.algorithms import Networks, Teacher
from physai.errors import UserError
from physai.policies import Critic, DeterministicActor, GaussianActor, GRUActor
from physai.transforms.normalization import Normalizer
from tests.composed import composed

ROWS, STEPS, MEMORY = 64, 6, 8


def make_teacher(seed=7):
    """What it does follows from a parameter alone, which no student sees."""
    torch.manual_seed(seed)
    actor = GaussianActor(2, 1, ["normalized_observation", "parameter"], [4], "torch.nn.Tanh", 1.0)
    with torch.no_grad():
        actor.network[0].weight[:, 0] = 0.0
        actor.network[-1].weight.mul_(200.0)  # for it starts near standstill
    return Teacher(actor, Normalizer(1, 10.0))


def make_student(remembers=True, seed=3):
    torch.manual_seed(seed)
    given = ["normalized_observation"], [16], "torch.nn.Tanh", 0.1
    return GRUActor(1, 1, *given, memory_size=MEMORY, past_actions=0) if remembers else GaussianActor(1, 1, *given)


def build(student, teacher, *overrides, frames=ROWS * STEPS):
    sizes = [f"collector.frames_per_batch={frames}", f"collector.num_envs={ROWS}", "algo.minibatch_size=96"]
    node = composed("algo=distill", "algo.teacher=elsewhere", *sizes, *overrides).algo
    networks = Networks(
        student, Critic(1, ["normalized_observation"], [2], "torch.nn.Tanh"), Normalizer(1, 10.0), lambda: None
    )
    partial = instantiate(node, _partial_=True, _convert_="all")
    return partial(networks=networks, frames_per_batch=frames, teacher=teacher)


def draw_batch(generator):
    """Only the first step of an episode shows the parameter, which holds for all of it."""
    parameter = torch.randn(ROWS, 1, 1, generator=generator).expand(ROWS, STEPS, 1)
    begins = torch.arange(STEPS)[None, :, None].expand(ROWS, STEPS, 1)
    seen = parameter * (begins == 0)
    data = {"observation": seen, "normalized_observation": seen, "parameter": parameter}
    data |= {"episode_length": begins, "memory": torch.zeros(ROWS, STEPS, MEMORY)}
    return TensorDict(data, [ROWS, STEPS])


def learn(algorithm, batches=40):
    generator = torch.Generator().manual_seed(1)
    return [algorithm.update(draw_batch(generator))["loss_bc"] for _ in range(batches)]


@pytest.mark.slow
def test_a_student_that_remembers_learns_what_only_the_teacher_sees_and_one_that_does_not_cannot():
    # two seconds, for the one thing that all of this is for
    fixed = "algo.scheduler=null", "algo.optimizer.lr=1e-2"
    remembers, forgets = (learn(build(make_student(kind), make_teacher(), *fixed)) for kind in (True, False))
    assert remembers[0] > 0.1
    assert remembers[-1] < 0.1 * remembers[0]
    assert forgets[-1] > 0.5 * forgets[0]


def test_the_teacher_sees_by_its_own_normalizer_and_answers_with_its_mean_action():
    teacher = make_teacher()
    with torch.no_grad():
        teacher.actor.network[0].weight[:, 0] = 1.0
    teacher.normalizer.loc.fill_(0.3)
    teacher.normalizer.scale.fill_(2.0)
    batch = draw_batch(torch.Generator().manual_seed(0))
    seen = torch.cat([(batch["observation"] - 0.3) / 2.0, batch["parameter"]], dim=-1)
    assert torch.equal(teacher(batch), torch.tanh(teacher.actor.network(seen)))
    assert torch.equal(batch["normalized_observation"], batch["observation"])  # the student's own


def test_the_loss_is_the_mean_squared_difference_of_the_mean_actions():
    student, teacher = make_student(), make_teacher()
    algorithm = build(student, teacher, "algo.minibatch_size=384", "algo.epochs=1")
    batch = draw_batch(torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = (torch.tanh(student.mean(batch)) - teacher(batch)).square().mean()
    assert algorithm.update(batch)["loss_bc"] == pytest.approx(float(expected), rel=1e-5)


def test_the_student_changes_and_the_teacher_does_not():
    student, teacher = make_student(), make_teacher()
    before = [{k: v.clone() for k, v in one.state_dict().items()} for one in (student, teacher.actor)]
    metrics = build(student, teacher).update(draw_batch(torch.Generator().manual_seed(0)))
    assert set(metrics) == {"loss_bc", "grad_norm", "lr"}
    changed = {key for key, value in student.state_dict().items() if not torch.equal(value, before[0][key])}
    assert changed == set(before[0]) - {"log_std"}  # exploration is not learned from a teacher
    assert all(torch.equal(value, before[1][key]) for key, value in teacher.actor.state_dict().items())


def test_state_continues_bit_for_bit():
    generator = torch.Generator().manual_seed(0)
    first, second = draw_batch(generator), draw_batch(generator)
    algorithm = build(make_student(), make_teacher())
    algorithm.update(first)
    file = io.BytesIO()
    torch.save(algorithm.state(), file)
    random = torch.get_rng_state()
    expected = algorithm.update(second)
    other = build(make_student(seed=4), make_teacher())
    file.seek(0)
    other.set_state(torch.load(file, weights_only=True))
    torch.set_rng_state(random)
    assert other.update(second) == expected


def test_a_student_without_a_mean_and_a_minibatch_larger_than_the_batch_are_refused():
    student = DeterministicActor(1, 1, ["normalized_observation"], [4], "torch.nn.Tanh", 0.1)
    with pytest.raises(UserError, match=r"policy\.actor: a student needs a mean .*; DeterministicActor has none"):
        build(student, make_teacher())
    with pytest.raises(UserError, match=r"algo\.minibatch_size: a minibatch of 1000 is larger than a batch"):
        build(make_student(), make_teacher(), "algo.minibatch_size=1000")
