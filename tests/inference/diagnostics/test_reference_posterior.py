"""Reference posteriors: guides compared with the oracle, with NUTS and by Stein discrepancies."""

import math
from functools import partial
from unittest import mock

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy import stats

import dvae
from dvae.inference.diagnostics.reference_posterior import ReferencePosterior
from dvae.inference.diagnostics.stein import _stein

T = 3
HIERARCHY = "p(w) p(z_t | z_{t-1}, w) p(x_t | z_t, w)"
MEAN_FIELD = "q(w | x_{1:T}) q(z_t | x_{1:T})"


def simulated(count=2):
    """A model with its best guide, the oracle, and data."""
    model = dvae.linear_gaussian_surrogate(HIERARCHY, MEAN_FIELD, {"w": 1, "z": 1, "x": 1}, T, scale=0.5)
    oracle = dvae.Oracle(model, T)
    oracle.fit_guide(100)
    torch.manual_seed(0)
    return model.requires_grad_(False), oracle, model.sample(count, T)["x"]


def posterior_by_nuts(*arguments, **options):
    """Return the reference posterior by NUTS, even of a linear-Gaussian model."""
    with mock.patch("dvae.inference.diagnostics.reference_posterior._exact", return_value=None):
        return dvae.reference_posterior(*arguments, progress=False, **options)


def exact(oracle):
    """Return the posterior as a Pyro guide, in any order of its latents."""

    def guide(batch):
        mean, covariance = oracle.posterior(batch)
        with pyro.plate("sequences", len(mean)):
            flat = pyro.sample("flat", dist.MultivariateNormal(mean, covariance))
            w, z = flat[:, :1], flat[:, 1:, None]
            pyro.sample("w", dist.Delta(w, event_dim=1))
            pyro.sample("z", dist.Delta(z, event_dim=2))

    return guide


@pytest.fixture(scope="module")
def mean_field():
    """Compare a mean-field guide with the oracle and with NUTS."""
    model, oracle, x = simulated()
    exact_result = dvae.reference_posterior(model, x, progress=False)
    by_nuts = posterior_by_nuts(model, x, [0], draws=100, chains=2, warmup=40)
    return model, oracle, x, exact_result, by_nuts


def test_the_reference_of_a_linear_gaussian_model_is_the_oracles(mean_field):
    _, oracle, x, exact_result, _ = mean_field
    mean, covariance = oracle.posterior(x)
    deviation = covariance.diagonal().sqrt()
    assert exact_result.exact
    np.testing.assert_allclose(exact_result.reference.mean, mean.numpy(), rtol=1e-12)
    for sequence in range(2):
        scaled = exact_result.reference.correlation[sequence] * np.outer(
            *[exact_result.reference.deviation[sequence]] * 2
        )
        np.testing.assert_allclose(scaled, covariance.numpy(), rtol=1e-12, atol=1e-15)
    assert (exact_result.reference.deviation == deviation.numpy()).all()


def test_nuts_agrees_with_the_oracle_within_its_errors(mean_field):
    """Test all numbers and pairs at once, by the largest error and by the spread of the errors."""
    *_, exact_result, by_nuts = mean_field
    sampled, expected = by_nuts.reference, exact_result.reference
    above = np.triu_indices(len(exact_result.names), 1)
    gaps = [
        (sampled.mean[0] - expected.mean[0]) / sampled.mean_error[0],
        (sampled.deviation[0] - expected.deviation[0]) / sampled.deviation_error[0],
        (sampled.correlation[0] - expected.correlation[0])[above] / sampled.correlation_error[0][above],
    ]
    for gap in gaps:
        assert abs(gap).max() < stats.norm.isf(1e-3 / gap.size / 2)
        independent = gap.size / 2  # a lower limit, because the numbers depend on each other
        assert gap.std() < math.sqrt(stats.chi2.isf(1e-3, independent) / independent)


def test_the_exact_posterior_as_a_guide_has_no_bias_and_the_right_scale(mean_field):
    model, oracle, x, *_ = mean_field
    result = dvae.reference_posterior(model, x, [1], guide=exact(oracle), progress=False)
    assert result.sequences == (1,)
    assert (abs(result.bias) < 4 * result.bias_error).all()
    assert (abs(result.ratio - 1) < 4 * result.ratio_error).all()
    off = ~np.eye(4, dtype=bool)
    assert (abs(result.correlation_difference) < 4 * result.correlation_difference_error)[:, off].all()


def test_padding_changes_no_posterior():
    model, _, x = simulated()
    few = {"draws": 8, "chains": 2, "warmup": 16, "guide_draws": 50}
    lengths = torch.tensor([2, 3])
    other = x.clone()
    other[0, 2] = 9.0
    exact = dvae.reference_posterior(model, {"x": x, "lengths": lengths}, progress=False)
    assert exact.exact
    for posterior in (partial(dvae.reference_posterior, progress=False), posterior_by_nuts):
        padded, again = (posterior(model, {"x": data, "lengths": lengths}, [0], **few) for data in (x, other))
        assert np.isnan(padded.bias[0]).tolist() == [False, False, False, True]  # w, z_1, z_2, z_3
        np.testing.assert_array_equal(padded.reference.mean, again.reference.mean)
        np.testing.assert_array_equal(padded.correlation_difference, again.correlation_difference)
        assert str(ReferencePosterior.from_json(padded.to_json())) == str(padded)
    np.testing.assert_allclose(
        exact.reference.mean[0, :3], dvae.Oracle(model, 2).posterior(x[:1, :2])[0][0], atol=1e-12
    )


def test_results_are_reproducible_stored_and_drawn(mean_field, tmp_path):
    model, _, x, exact_result, by_nuts = mean_field
    state = torch.random.get_rng_state()
    again = dvae.reference_posterior(model, x, progress=False)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert again.to_json() == exact_result.to_json()
    tested = dvae.stein_discrepancy(model, x, draws=20, bootstrap=19, progress=False)
    for result in (exact_result, by_nuts, tested):
        result.save(tmp_path / "found.json")
        loaded = type(result).load(tmp_path / "found.json")
        assert str(loaded) == str(result)
        assert loaded.to_json() == result.to_json()
        result.plot().savefig(tmp_path / "found.png")
    for result in (exact_result, tested):
        with pytest.raises(ValueError, match="not written by"):
            type(result).of({**result.document(), "attributes": result.document()["attributes"] | {"sequences": [0]}})


# ------------------------------------------------------------------------------------------------ Stein discrepancies


def test_the_stein_kernel_is_built_from_derivatives_of_its_base_kernel():
    u, score = torch.randn(2, 4, 3).double()
    pairs = _stein(u, score)

    def kernel(one, other):
        return (1 + (one - other).square().sum() / 6) ** -0.5

    for i, j in ((0, 1), (2, 0), (3, 2)):
        to_one, to_other = torch.autograd.functional.jacobian(kernel, (u[i], u[j]))
        second_derivatives = torch.autograd.functional.hessian(kernel, (u[i], u[j]))[0][1].trace()
        right = score[i] @ score[j] * kernel(u[i], u[j]) + score[i] @ to_other + score[j] @ to_one + second_derivatives
        torch.testing.assert_close(pairs[i, j], right)


def rejection_count(model, x, draws, **options):
    result = dvae.stein_discrepancy(model, x, draws=draws, bootstrap=99, progress=False, **options)
    return int((result.p_values <= 0.05).sum()), result


def test_posterior_draws_keep_the_level_and_mean_field_draws_are_rejected():
    """Use 60 sequences; the test rejects more of them with more draws."""
    model, oracle, x = simulated(count=60)
    count, rejections = rejection_count(model, x, 100, guide=exact(oracle))
    assert stats.binom.sf(count - 1, 60, 0.05) > 1e-3
    assert rejections.p_value > 1e-3
    (few, together), (many, _) = (rejection_count(model, x, draws) for draws in (50, 300))
    assert few < many
    assert stats.binom.sf(many - 1, 60, 0.05) < 1e-6
    assert together.p_value <= 0.01  # all sequences together are rejected with the fewest draws
