"""Scores of forecasts: their definitions, written out with loops, and the laws they obey."""

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
    gaussian_frechet_distance,
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
    motion_pseudo_values,
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


def by_the_letter(samples, truths):
    """Every score of samples (K, T, D) by definition; the true future is the first of truths (M, T, D)."""
    count, frames, size = samples.shape
    norm = np.linalg.norm
    apart = [norm(samples[j] - samples[k]) for j in range(count) for k in range(j)]
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
        average_pairwise_distance: np.mean(apart) if apart else 0.0,
        average_displacement_error: min(ade[0]),
        final_displacement_error: min(fde[0]),
        median_average_displacement_error: np.median(ade[0]),
        median_final_displacement_error: np.median(fde[0]),
        multimodal_average_displacement_error: np.mean([min(errors) for errors in ade]),
        multimodal_final_displacement_error: np.mean([min(errors) for errors in fde]),
        median_multimodal_average_displacement_error: np.mean([np.median(errors) for errors in ade]),
        median_multimodal_final_displacement_error: np.mean([np.median(errors) for errors in fde]),
        continuous_ranked_probability_score: abs(samples - truth).mean() - (np.mean(numbers) if numbers else 0.0) / 2,
        energy_score: np.mean([norm(s - truth) for s in samples]) - (np.mean(apart) if apart else 0.0) / 2,
        variogram_score: np.mean(variogram) if variogram else 0.0,
    }


@settings(max_examples=30, deadline=None)
@given(SIZES)
def test_every_score_is_its_definition_at_every_size(sizes):
    count, modes, frames, size, seed = sizes
    samples, truths = draw(count, frames, size, seed=seed), draw(modes, frames, size, seed=seed + 1)
    for score, expected in by_the_letter(samples.numpy(), truths.numpy()).items():
        if score is average_pairwise_distance:
            found = score(samples)
        else:
            found = score(samples, truths if score in MULTIMODAL else truths[0])
        assert found.item() == pytest.approx(expected, abs=1e-7), score.__name__


@pytest.mark.parametrize("score", [average_pairwise_distance, *PAIRED, *MULTIMODAL])
def test_leading_dimensions_are_windows_scored_alone(score):
    samples, truths = draw(2, 3, 5, 4, 6), draw(2, 3, 2, 4, 6, seed=1)
    rest = () if score is average_pairwise_distance else (truths if score in MULTIMODAL else truths[:, :, 0],)
    together = score(samples, *rest)
    assert together.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(together[i, j], score(samples[i, j], *(r[i, j] for r in rest)))


@pytest.mark.parametrize("score", [*PAIRED, *MULTIMODAL])
def test_order_of_samples_is_irrelevant_and_numpy_is_accepted(score):
    samples, truth = draw(5, 4, 3), draw(4, 3, seed=1)
    truth = truth[None] if score in MULTIMODAL else truth
    expected = score(samples, truth)
    torch.testing.assert_close(score(samples.flip(0), truth), expected)
    torch.testing.assert_close(score(samples.numpy(), truth.numpy()), expected)


def test_the_best_sample_counts_and_the_error_is_in_metres_over_all_coordinates():
    truth = torch.zeros(2, 4, dtype=torch.float64)
    samples = torch.stack([torch.full((2, 4), 3.0), torch.tensor([[1.0] * 4, [2.0] * 4])]).double()
    assert average_displacement_error(samples, truth) == pytest.approx((2 + 4) / 2)
    assert final_displacement_error(samples, truth) == pytest.approx(4)
    assert median_final_displacement_error(samples, truth) == pytest.approx((4 + 6) / 2)
    assert average_displacement_error(truth[None], truth) == 0


def test_diversity_is_not_divided_by_time_and_one_sample_has_none():
    still = torch.zeros(1, 9, 4)
    assert average_pairwise_distance(still) == 0
    assert average_pairwise_distance(torch.cat([still, still + 1])) == pytest.approx(math.sqrt(9 * 4))


def test_single_precision_products_do_not_blur_coinciding_futures():
    futures = (2 + draw(60, 30, 60) / 3).float()
    assert multimodal_average_displacement_error(futures, futures) < 2e-3


def test_energy_score_of_a_point_is_its_distance():
    sample, truth = draw(1, 3, 2), draw(3, 2, seed=1)
    assert energy_score(sample, truth) == pytest.approx((sample[0] - truth).norm().item())


def test_energy_score_takes_a_diversity_that_is_known():
    samples, truth = draw(3, 5, 4, 2), draw(3, 4, 2, seed=1)
    known = energy_score(samples, truth, average_pairwise_distance(samples))
    torch.testing.assert_close(known, energy_score(samples, truth))


def test_energy_score_prefers_the_true_distribution_to_a_narrow_a_wide_and_a_shifted_one():
    samples, truth = draw(2000, 20, 3, 2), draw(2000, 3, 2, seed=1)
    right = energy_score(samples, truth)
    for wrong in (0.3 * samples, 3 * samples, samples + 1):
        excess = energy_score(wrong, truth) - right
        assert excess.mean() > 4 * excess.std() / math.sqrt(len(excess))


def test_best_of_many_rewards_spread_that_the_energy_score_punishes():
    samples, truth = draw(200, 20, 1, 12), 0.2 * draw(200, 1, 12, seed=1)
    right, wide = 0.2 * samples, torch.cat([0.2 * samples, 2 * draw(200, 200, 1, 12, seed=2)], 1)
    assert average_displacement_error(wide, truth).mean() <= average_displacement_error(right, truth).mean()
    assert energy_score(wide, truth).mean() > energy_score(right, truth).mean()


def test_variogram_score_sees_lost_dependence_and_not_a_common_offset():
    common = draw(500, 20, 1, 1) + 0.1 * draw(500, 20, 1, 4, seed=1)
    truth = draw(500, 1, 1, seed=2) + 0.1 * draw(500, 1, 4, seed=3)
    independent = draw(500, 20, 1, 4, seed=4)
    assert variogram_score(common, truth).mean() < 0.2 * variogram_score(independent, truth).mean()
    torch.testing.assert_close(variogram_score(common + 7, truth), variogram_score(common, truth))


# Fréchet distance of features


@pytest.mark.parametrize("rows", [3, 8, 200])  # with covariances of full rank and of less
def test_frechet_distance_of_a_set_from_itself_is_exactly_zero_in_any_order(rows):
    features = draw(rows, 6) @ draw(6, 6, seed=1) + 5
    assert frechet_distance(features, features) == 0
    assert frechet_distance(features, features.flip(0)) == 0
    assert frechet_distance(features, features + 1e-3).item() == pytest.approx(6e-6, rel=1e-6)


@given(st.integers(2, 40), st.integers(2, 40), st.integers(1, 6), st.integers(0, 999))
def test_frechet_distance_is_that_of_normal_fits_by_another_formula(first, second, size, seed):
    a, b = draw(first, size, seed=seed), draw(second, size, seed=seed + 1) @ draw(size, size, seed=seed + 2) + 1
    if min(first, second) <= size:  # sqrtm wants full rank
        a, b = torch.cat([a, draw(size + 1, size, seed=seed + 3)]), torch.cat([b, draw(size + 1, size, seed=seed + 4)])
    means, covariances = zip(*((x.mean(0).numpy(), np.cov(x.T.numpy()).reshape(size, size)) for x in (a, b)))
    root = scipy.linalg.sqrtm(covariances[0] @ covariances[1]).real
    expected = ((means[0] - means[1]) ** 2).sum() + np.trace(covariances[0] + covariances[1] - 2 * root)
    assert frechet_distance(a, b).item() == pytest.approx(expected, rel=1e-6)
    assert frechet_distance(b.numpy(), a.numpy()).item() == pytest.approx(expected, rel=1e-6)


def test_frechet_distance_of_normals_in_closed_form():
    mean, other, scales = draw(3), draw(3, seed=1), draw(2, 3, seed=2).abs()
    turn = torch.linalg.qr(draw(3, 3, seed=3)).Q
    first, second = ((turn * scale.square()) @ turn.T for scale in scales)
    expected = (mean - other).square().sum() + (scales[0] - scales[1]).square().sum()  # of covariances that commute
    torch.testing.assert_close(gaussian_frechet_distance(mean, first, other, second), expected)
    batch = gaussian_frechet_distance(
        torch.stack([mean, other]), torch.stack([first, second]), torch.stack([other, other]), torch.stack([second] * 2)
    )
    torch.testing.assert_close(batch, torch.stack([expected, torch.zeros_like(expected)]))
    point = torch.zeros(3, 3, dtype=torch.float64)
    torch.testing.assert_close(
        gaussian_frechet_distance(mean, point, mean, first), scales[0].square().sum()
    )  # a collapsed set lies as far off as the other one is wide


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: frechet_distance(draw(1, 3), draw(4, 3)), r"N and M at least 2, not \(1, 3\) and \(4, 3\)"),
        (lambda: frechet_distance(draw(5, 2), draw(4, 3)), r"not \(5, 2\) and \(4, 3\)"),
        (lambda: frechet_distance(draw(5), draw(4)), r"needs features \(N, F\)"),
        (lambda: average_pairwise_distance(draw(4, 3)), "axis for K = 1"),
        (lambda: average_pairwise_distance(draw(0, 4, 3)), "nothing to score"),
        (lambda: average_displacement_error(draw(5, 4, 3), draw(3, 3)), r"of shape \(4, 3\), not \(3, 3\)"),
        (lambda: average_displacement_error(draw(5, 2, 4, 3), draw(2, 4, 3)), "movedim"),
        (lambda: multimodal_average_displacement_error(draw(5, 4, 3), draw(4, 3)), "differ from them in M"),
        (lambda: multimodal_final_displacement_error(draw(5, 4, 3), draw(0, 4, 3)), "M at least 1"),
        (lambda: variogram_score(draw(5, 4, 3), draw(4, 3), order=0), "order of a variogram"),
    ],
)
def test_what_does_not_fit_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("count", [2, 5, 40])
def test_crps_of_normal_draws_is_the_closed_form_at_every_number_of_them(count):
    """s (z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi)), z = (y - m) / s (Gneiting et al. 2005)."""
    location, scale, repeats = 0.3, 1.7, 4000
    truth = torch.linspace(-4, 5, 7, dtype=torch.float64)[None]  # (T, D) = (1, 7)
    samples = location + scale * draw(repeats, count, 1, 7)
    found = continuous_ranked_probability_score(samples, truth.expand(repeats, 1, 7))
    z = (truth - location) / scale
    normal = torch.distributions.Normal(0.0, 1.0)
    exact = scale * (z * (2 * normal.cdf(z) - 1) + 2 * normal.log_prob(z).exp() - 1 / math.sqrt(math.pi))
    assert abs(found.mean() - exact.mean()) < 4 * found.std() / math.sqrt(repeats)


def test_variogram_score_has_the_same_expectation_at_every_number_of_samples():
    """The difference of two standard normals is N(0, 2), so that E v^2 = E |d| and E v = E |d|^(1/2) are known."""
    truth = torch.tensor([[0.3, 1.6]], dtype=torch.float64)
    mean = 2**0.25 * 2**0.25 * math.gamma(0.75) / math.sqrt(math.pi)
    exact = (math.sqrt(1.3) - mean) ** 2
    for count in (2, 5, 40):
        found = variogram_score(draw(20_000, count, 1, 2), truth.expand(20_000, 1, 2))
        assert abs(found.mean() - exact) < 4 * found.std() / math.sqrt(len(found)), count


@pytest.mark.parametrize("count", [1, 3])
def test_apde_is_how_far_two_diversities_are_apart(count):
    samples, truths = draw(2, count, 4, 3), draw(2, 5, 4, 3, seed=1)
    found = average_pairwise_distance_error(samples, truths)
    for n in range(2):
        ours, theirs = (
            [float((x[i] - x[j]).square().sum().sqrt()) for i in range(len(x)) for j in range(i)]
            for x in (samples[n], truths[n])
        )
        assert found[n] == pytest.approx(abs((np.mean(ours) if ours else 0.0) - np.mean(theirs)))
    assert (average_pairwise_distance_error(truths.flip(1) + 2.0, truths) < 1e-12).all()
    assert average_pairwise_distance_error(samples, truths[:, :1]).isnan().all()


def test_cmd_is_the_area_between_cumulative_motions():
    """sum_{i<T} sum_{t<=i} |M_t - M|; 0 at the pace of real motion, and the earlier a deviation the more it counts."""
    motion, real = draw(2, 6).abs(), draw(2, seed=1).abs()
    found = cumulative_motion_distance(motion, real)
    for n in range(2):
        area = sum(abs(motion[n, t] - real[n]) for i in range(6) for t in range(i + 1))
        assert found[n] == pytest.approx(float(area))
    steady = real[:, None].expand(-1, 6)
    assert cumulative_motion_distance(steady, real).tolist() == [0, 0]
    early, late = (cumulative_motion_distance(steady + torch.eye(6)[t], real) for t in (0, 5))
    torch.testing.assert_close(early, 6 * late)
    with pytest.raises(ValueError, match=r"needs a pace .* not \(2, 6\) and \(6,\)"):
        cumulative_motion_distance(motion, motion[0])


def test_cmd_of_a_set_is_of_its_classes_and_leaves_out_clip_after_clip():
    motion, real = draw(9, 5).abs(), draw(9, seed=1).abs()
    classes, places = torch.tensor([0, 0, 0, 1, 1, 1, 1, 1, 2]), torch.tensor([0, 0, 1, 2, 2, 2, 3, 3, 4])

    def by_hand(rows):
        total = 0.0
        for number in {int(classes[n]) for n in rows}:
            own = [n for n in rows if classes[n] == number]
            pace = sum(real[n] for n in own) / len(own)
            means = [sum(motion[n, t] for n in own) / len(own) for t in range(5)]
            total += len(own) / len(rows) * sum((5 - t) * abs(means[t] - pace) for t in range(5))
        return float(total)

    values = motion_pseudo_values(motion, real, classes, places)
    shares = places.bincount() / 9
    assert float(torch.tensor(values) @ shares) == pytest.approx(by_hand(range(9)))
    own = [by_hand(range(9)) - by_hand([n for n in range(9) if places[n] != c]) for c in range(5)]
    plain = [(1 / float(w) - 1) * d for w, d in zip(shares, own, strict=True)]
    moved = [v - p for v, p in zip(values, plain, strict=True)]
    assert moved == pytest.approx([moved[0]] * 5, rel=1e-5)  # by one constant
    (alone,) = motion_pseudo_values(motion, real, classes, torch.zeros(9, dtype=torch.long))
    assert alone == pytest.approx(by_hand(range(9)))
