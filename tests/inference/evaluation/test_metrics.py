"""Scores of forecasts: their definitions, written out with loops, and the distributions they obey."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvae.inference.evaluation.metrics import (
    average_pairwise_distance,
    continuous_ranked_probability_score,
    energy_score,
    frechet_distance,
    variogram_score,
)
from dvae.motion.scoring.metrics import (
    average_displacement_error,
    average_pairwise_distance_error,
    cumulative_motion_distance,
    final_displacement_error,
    median_average_displacement_error,
    median_final_displacement_error,
    median_multimodal_average_displacement_error,
    median_multimodal_final_displacement_error,
    multimodal_average_displacement_error,
    multimodal_final_displacement_error,
)

PAIRED = (
    average_displacement_error,
    final_displacement_error,
    median_average_displacement_error,
    median_final_displacement_error,
    continuous_ranked_probability_score,
    energy_score,
    variogram_score,
)
MULTIMODAL = (
    multimodal_average_displacement_error,
    multimodal_final_displacement_error,
    median_multimodal_average_displacement_error,
    median_multimodal_final_displacement_error,
)
SIZES = st.tuples(*[st.integers(1, 4)] * 4, st.integers(0, 2**16))


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def by_definition(samples, truths):
    """Return every score of samples (K, T, D) by its definition; the true future is the first of truths (M, T, D)."""
    count, frames, size = samples.shape
    norm = np.linalg.norm
    pair_distances = [norm(samples[j] - samples[k]) for j in range(count) for k in range(j)]
    ade = [[np.mean([norm(s[t] - y[t]) for t in range(frames)]) for s in samples] for y in truths]
    fde = [[norm(s[-1] - y[-1]) for s in samples] for y in truths]
    pairs = [(t, i, j) for t in range(frames) for i in range(size) for j in range(i)]
    truth = truths[0]
    numbers = [abs(samples[j] - samples[k]).mean() for j in range(count) for k in range(j)]
    variogram = []
    for t, i, j in pairs:
        values = abs(samples[:, t, i] - samples[:, t, j]) ** 0.5
        error = np.var(values, ddof=1) / count if count > 1 else 0.0
        variogram.append((abs(truth[t, i] - truth[t, j]) ** 0.5 - values.mean()) ** 2 - error)
    return {
        average_pairwise_distance: np.mean(pair_distances) if pair_distances else 0.0,
        average_displacement_error: min(ade[0]),
        final_displacement_error: min(fde[0]),
        median_average_displacement_error: np.median(ade[0]),
        median_final_displacement_error: np.median(fde[0]),
        multimodal_average_displacement_error: np.mean([min(errors) for errors in ade]),
        multimodal_final_displacement_error: np.mean([min(errors) for errors in fde]),
        median_multimodal_average_displacement_error: np.mean([np.median(errors) for errors in ade]),
        median_multimodal_final_displacement_error: np.mean([np.median(errors) for errors in fde]),
        continuous_ranked_probability_score: abs(samples - truth).mean() - (np.mean(numbers) if numbers else 0.0) / 2,
        energy_score: np.mean([norm(s - truth) for s in samples])
        - (np.mean(pair_distances) if pair_distances else 0.0) / 2,
        variogram_score: np.mean(variogram) if variogram else 0.0,
    }


@settings(max_examples=30, deadline=None)
@given(SIZES)
def test_every_score_equals_its_definition_at_every_size(sizes):
    count, modes, frames, size, seed = sizes
    samples, truths = draw(count, frames, size, seed=seed), draw(modes, frames, size, seed=seed + 1)
    for score, expected in by_definition(samples.numpy(), truths.numpy()).items():
        if score is average_pairwise_distance:
            values = score(samples)
        else:
            values = score(samples, truths if score in MULTIMODAL else truths[0])
        assert values.item() == pytest.approx(expected, abs=1e-7), score.__name__


@pytest.mark.parametrize("score", [average_pairwise_distance, *PAIRED, *MULTIMODAL])
def test_windows_are_scored_independently_and_the_order_of_samples_is_irrelevant(score):
    samples, truths = draw(2, 3, 5, 4, 6), draw(2, 3, 2, 4, 6, seed=1)
    rest = () if score is average_pairwise_distance else (truths if score in MULTIMODAL else truths[:, :, 0],)
    together = score(samples, *rest)
    assert together.shape == (2, 3)
    torch.testing.assert_close(score(samples.flip(2).numpy(), *(r.numpy() for r in rest)), together)  # in any order
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(together[i, j], score(samples[i, j], *(r[i, j] for r in rest)))


# Fréchet distance of features


@pytest.mark.parametrize("rows", [3, 8, 200])  # with covariances of full rank and of less
def test_frechet_distance_of_a_set_from_itself_is_exactly_zero_in_any_order(rows):
    features = draw(rows, 6) @ draw(6, 6, seed=1) + 5
    assert frechet_distance(features, features) == 0
    assert frechet_distance(features, features.flip(0)) == 0
    assert frechet_distance(features, features + 1e-3).item() == pytest.approx(6e-6, rel=1e-6)


@given(st.integers(2, 40), st.integers(2, 40), st.integers(1, 6), st.integers(0, 999))
def test_frechet_distance_equals_that_of_fitted_normals_by_another_formula(first, second, size, seed):
    a, b = draw(first, size, seed=seed), draw(second, size, seed=seed + 1) @ draw(size, size, seed=seed + 2) + 1
    if min(first, second) <= size:  # sqrtm wants full rank
        a, b = torch.cat([a, draw(size + 1, size, seed=seed + 3)]), torch.cat([b, draw(size + 1, size, seed=seed + 4)])
    means, covariances = zip(*((x.mean(0).numpy(), np.cov(x.T.numpy()).reshape(size, size)) for x in (a, b)))
    root = scipy.linalg.sqrtm(covariances[0] @ covariances[1]).real
    expected = ((means[0] - means[1]) ** 2).sum() + np.trace(covariances[0] + covariances[1] - 2 * root)
    assert frechet_distance(a, b).item() == pytest.approx(expected, rel=1e-6)
    assert frechet_distance(b.numpy(), a.numpy()).item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("count", [1, 3])
def test_apde_is_the_difference_of_two_diversities(count):
    samples, truths = draw(2, count, 4, 3), draw(2, 5, 4, 3, seed=1)
    error = average_pairwise_distance_error(samples, truths)
    for n in range(2):
        sample_diversity, truth_diversity = (
            [float((x[i] - x[j]).square().sum().sqrt()) for i in range(len(x)) for j in range(i)]
            for x in (samples[n], truths[n])
        )
        assert error[n] == pytest.approx(
            abs((np.mean(sample_diversity) if sample_diversity else 0.0) - np.mean(truth_diversity))
        )
    assert (average_pairwise_distance_error(truths.flip(1) + 2.0, truths) < 1e-12).all()
    assert average_pairwise_distance_error(samples, truths[:, :1]).isnan().all()


def test_cmd_is_the_area_between_cumulative_motion_curves():
    """sum_{i<T} sum_{t<=i} |M_t - M|: 0 at the pace of real motion, and larger for earlier deviations."""
    motion, real = draw(2, 6).abs(), draw(2, seed=1).abs()
    distance = cumulative_motion_distance(motion, real)
    for n in range(2):
        area = sum(abs(motion[n, t] - real[n]) for i in range(6) for t in range(i + 1))
        assert distance[n] == pytest.approx(float(area))
    steady = real[:, None].expand(-1, 6)
    assert cumulative_motion_distance(steady, real).tolist() == [0, 0]
    early, late = (cumulative_motion_distance(steady + torch.eye(6)[t], real) for t in (0, 5))
    torch.testing.assert_close(early, 6 * late)
    with pytest.raises(ValueError, match="T at least 2"):
        cumulative_motion_distance(motion, motion[0])


def test_a_future_without_values_has_no_score():
    samples, truth = draw(3, 4, 2, seed=0), torch.full((4, 2), math.nan)
    for score in (continuous_ranked_probability_score, energy_score, variogram_score):
        assert score(samples, truth).isnan(), score.__name__
