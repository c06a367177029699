"""Reference posteriors beside a guide: the oracle's where it is known, and what NUTS and Stein's identity say."""

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
    """The reference posterior of a model as if it were not linear-Gaussian."""
    with mock.patch("dvae.inference.diagnostics.reference_posterior._exact", return_value=None):
        return dvae.reference_posterior(*arguments, progress=False, **options)


def exact(oracle):
    """The posterior as a Pyro guide, whatever the order of its latents."""

    def guide(batch):
        mean, covariance = oracle.posterior(batch)
        with pyro.plate("sequences", len(mean)):
            flat = pyro.sample("flat", dist.MultivariateNormal(mean, covariance))
            w, z = flat[:, :1], flat[:, 1:, None]
            pyro.sample("w", dist.Delta(w, event_dim=1))
            pyro.sample("z", dist.Delta(z, event_dim=2))

    return guide


@pytest.fixture(scope="module")
def beside():
    """What the oracle says of a mean-field guide, and what NUTS does."""
    model, oracle, x = simulated()
    known = dvae.reference_posterior(model, x, progress=False)
    by_nuts = posterior_by_nuts(model, x, [0], draws=100, chains=2, warmup=40)
    return model, oracle, x, known, by_nuts


def test_of_a_linear_gaussian_model_the_reference_is_the_oracles(beside):
    _, oracle, x, known, _ = beside
    mean, covariance = oracle.posterior(x)
    deviation = covariance.diagonal().sqrt()
    assert known.exact
    np.testing.assert_allclose(known.reference.mean, mean.numpy(), rtol=1e-12)
    for sequence in range(2):
        scaled = known.reference.correlation[sequence] * np.outer(*[known.reference.deviation[sequence]] * 2)
        np.testing.assert_allclose(scaled, covariance.numpy(), rtol=1e-12, atol=1e-15)
    assert (known.reference.deviation == deviation.numpy()).all()


def test_nuts_agrees_with_the_oracle_within_its_errors(beside):
    """All numbers and all pairs at once, by the largest of so many standard normals, and by their spread."""
    *_, known, by_nuts = beside
    ours, theirs = by_nuts.reference, known.reference
    above = np.triu_indices(len(known.names), 1)
    gaps = [
        (ours.mean[0] - theirs.mean[0]) / ours.mean_error[0],
        (ours.deviation[0] - theirs.deviation[0]) / ours.deviation_error[0],
        (ours.correlation[0] - theirs.correlation[0])[above] / ours.correlation_error[0][above],
    ]
    for gap in gaps:
        assert abs(gap).max() < stats.norm.isf(1e-3 / gap.size / 2)
        independent = gap.size / 2  # at the least, as numbers depend on each other
        assert gap.std() < math.sqrt(stats.chi2.isf(1e-3, independent) / independent)


def test_a_guide_that_is_the_posterior_has_neither_bias_nor_another_scale(beside):
    model, oracle, x, *_ = beside
    found = dvae.reference_posterior(model, x, [1], guide=exact(oracle), progress=False)
    assert found.sequences == (1,)
    assert (abs(found.bias) < 4 * found.bias_error).all()
    assert (abs(found.ratio - 1) < 4 * found.ratio_error).all()
    off = ~np.eye(4, dtype=bool)
    assert (abs(found.lack) < 4 * found.lack_error)[:, off].all()


def test_padding_has_no_posterior_and_changes_none():
    model, _, x = simulated()
    few = {"draws": 8, "chains": 2, "warmup": 16, "guide_draws": 50}
    lengths = torch.tensor([2, 3])
    other = x.clone()
    other[0, 2] = 9.0
    exact = dvae.reference_posterior(model, {"x": x, "lengths": lengths}, progress=False)
    assert exact.exact
    for posterior in (partial(dvae.reference_posterior, progress=False), posterior_by_nuts):
        found, again = (posterior(model, {"x": data, "lengths": lengths}, [0], **few) for data in (x, other))
        assert np.isnan(found.bias[0]).tolist() == [False, False, False, True]  # w, z_1, z_2, z_3
        np.testing.assert_array_equal(found.reference.mean, again.reference.mean)
        np.testing.assert_array_equal(found.lack, again.lack)
        assert str(ReferencePosterior.from_json(found.to_json())) == str(found)
    np.testing.assert_allclose(
        exact.reference.mean[0, :3], dvae.Oracle(model, 2).posterior(x[:1, :2])[0][0], atol=1e-12
    )


def test_results_are_seeded_kept_and_drawn(beside, tmp_path):
    model, _, x, known, by_nuts = beside
    state = torch.random.get_rng_state()
    again = dvae.reference_posterior(model, x, progress=False)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert again.to_json() == known.to_json()
    tested = dvae.stein_discrepancy(model, x, draws=20, bootstrap=19, progress=False)
    for found in (known, by_nuts, tested):
        found.save(tmp_path / "found.json")
        read = type(found).load(tmp_path / "found.json")
        assert str(read) == str(found)
        assert read.to_json() == found.to_json()
        found.plot().savefig(tmp_path / "found.png")
    for found in (known, tested):
        with pytest.raises(ValueError, match="not written by"):
            type(found).of({**found.document(), "attributes": found.document()["attributes"] | {"sequences": [0]}})


# ------------------------------------------------------------------------------------------------ Stein discrepancies


def test_the_stein_kernel_is_made_of_the_derivatives_of_its_kernel():
    u, score = torch.randn(2, 4, 3).double()
    pairs = _stein(u, score)

    def kernel(one, other):
        return (1 + (one - other).square().sum() / 6) ** -0.5

    for i, j in ((0, 1), (2, 0), (3, 2)):
        to_one, to_other = torch.autograd.functional.jacobian(kernel, (u[i], u[j]))
        mixed = torch.autograd.functional.hessian(kernel, (u[i], u[j]))[0][1].trace()
        right = score[i] @ score[j] * kernel(u[i], u[j]) + score[i] @ to_other + score[j] @ to_one + mixed
        torch.testing.assert_close(pairs[i, j], right)


def rejected(model, x, draws, **options):
    found = dvae.stein_discrepancy(model, x, draws=draws, bootstrap=99, progress=False, **options)
    return int((found.p_values <= 0.05).sum()), found


def test_draws_from_the_posterior_keep_the_level_and_those_of_a_mean_field_guide_do_not():
    """Of 60 sequences; with more draws, more are told. Ratios of one guide's draws are the exact posterior's."""
    model, oracle, x = simulated(count=60)
    count, found = rejected(model, x, 100, guide=exact(oracle))
    assert stats.binom.sf(count - 1, 60, 0.05) > 1e-3
    assert found.p_value > 1e-3
    (few, together), (many, _) = (rejected(model, x, draws) for draws in (50, 300))
    assert few < many
    assert stats.binom.sf(many - 1, 60, 0.05) < 1e-6
    assert together.p_value <= 0.01  # all sequences together are told by the fewest draws
