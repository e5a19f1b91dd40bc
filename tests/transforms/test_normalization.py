import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from physai.transforms import Normalizer, RunningStatistics

OFFSET = np.array([0.0, -5.0, 3.0, 40.0])
SPREAD = np.array([1.0, 0.1, 7.0, 0.5])


def batches(shapes, seed=0):
    random = np.random.default_rng(seed)
    return [torch.from_numpy(random.normal(OFFSET, SPREAD, (*shape, 4)).astype(np.float32)) for shape in shapes]


def statistics(eps=1e-3, clip=10.0):
    return RunningStatistics(Normalizer(4, clip), eps)


def all_rows(observations):
    return np.concatenate([batch.reshape(-1, 4).double().numpy() for batch in observations])


def test_statistics_equal_numpy_s_over_uneven_batches_of_any_shape():
    transform = statistics()
    seen = batches([(1,), (7,), (128, 32), (3, 5), (2, 2, 2), (1000,)])
    for count, batch in enumerate(seen, 1):
        transform.update(batch)
        rows = all_rows(seen[:count])
        np.testing.assert_allclose(transform.mean.numpy(), rows.mean(0), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(transform.variance.numpy(), rows.var(0), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(transform.normalizer.loc.numpy(), rows.mean(0), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(
            transform.normalizer.scale.numpy(), np.maximum(rows.std(0), 1e-3), rtol=1e-5, atol=1e-5
        )
        assert transform.count == len(rows)


@settings(max_examples=30, deadline=None)
@given(sizes=st.lists(st.integers(1, 40), min_size=1, max_size=8), seed=st.integers(0, 1000))
def test_how_observations_are_cut_into_batches_does_not_matter(sizes, seed):
    transform, whole = statistics(), statistics()
    seen = batches([(size,) for size in sizes], seed)
    for batch in seen:
        transform.update(batch)
    whole.update(torch.cat(seen))
    torch.testing.assert_close(transform.normalizer.loc, whole.normalizer.loc, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(transform.normalizer.scale, whole.normalizer.scale, rtol=1e-6, atol=1e-6)


def test_normalized_is_the_clipped_distance_from_the_mean_in_standard_deviations():
    transform = statistics(clip=2.0)
    (seen,) = batches([(500,)])
    transform.update(seen)
    rows = all_rows([seen])
    expected = np.clip((rows - rows.mean(0)) / rows.std(0), -2.0, 2.0)
    found = transform.normalizer(seen)
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=2e-4)
    assert found.abs().max() == 2.0
    assert (found.abs() == 2.0).double().mean() == pytest.approx(0.0455, abs=0.02)


def test_normalizing_changes_no_statistics_and_none_means_no_change():
    transform = statistics()
    (seen,) = batches([(50,)])
    assert torch.equal(transform.normalizer(seen), seen.clamp(-10, 10))
    assert transform.count == 0


def test_what_never_varies_is_divided_by_eps():
    transform = statistics(eps=0.01)
    transform.update(torch.full((30, 4), 2.5))
    assert transform.normalizer.scale.tolist() == pytest.approx([0.01] * 4)
    torch.testing.assert_close(transform.normalizer(torch.full((4,), 2.51)), torch.ones(4), rtol=1e-3, atol=0)


def test_state_dict_carries_the_statistics():
    transform, restored = statistics(), statistics()
    seen = batches([(20,), (30,)])
    transform.update(seen[0])
    restored.load_state_dict(transform.state_dict())
    for each in (transform, restored):
        each.update(seen[1])
    assert torch.equal(transform.normalizer.loc, restored.normalizer.loc)
    assert torch.equal(transform.normalizer.scale, restored.normalizer.scale)
    assert torch.equal(transform.mean, restored.mean)
