"""Ensembles: densities of the mixture, and forecasts pooled from all models."""

import math

import numpy as np
import pytest
import torch

from dvae import ArrayWindows, DynamicalVAE, Ensemble, Oracle, compare, evaluate, linear_gaussian_surrogate

T = 5
AUTOREGRESSIVE = ("p(x_t | x_{t-1})", "", {"x": 2})
QUIET = {"particles": 4, "contrasts": 0, "samples": 0, "progress": False}


def surrogates(count=3, pair=AUTOREGRESSIVE):
    return [linear_gaussian_surrogate(*pair, T, seed, scale=0.5) for seed in range(count)]


def mixed(models, x):
    logs = torch.stack([Oracle(model, x.shape[1]).evidence(x) for model in models])
    return (logs.logsumexp(0) - math.log(len(models))).detach().numpy()


def test_bounds_and_future_densities_are_those_of_the_mixture():
    models = surrogates()
    x = models[0].sample(7, T)["x"]
    options = {**QUIET, "leave_future_out": (2, 1), "filter_particles": 2, "estimates": 2}
    result = compare({"seeds": models, "mixture": Ensemble(models)}, x, **options)
    row = result.rows["mixture"]
    for name in ("ELBO", "IWAE bound", "FIVO bound"):
        np.testing.assert_allclose(row.bounds[name][0], mixed(models, x), atol=1e-8)
    np.testing.assert_allclose(row.bounds["LFO"][0], mixed(models, x) - mixed(models, x[:, :2]), atol=1e-8)
    np.testing.assert_allclose(row.estimates, np.stack([mixed(models, x)] * 2), atol=1e-8)
    assert (row.seeds, result.rows["seeds"].seeds) == (1, 3)
    assert result.mixtures == {"mixture": 3}
    assert "mixture of 3" in str(result)
    assert type(result).from_json(result.to_json()).mixtures == result.mixtures
    alone = [compare({name: each}, x, **options) for name, each in (("seeds", models), ("mixture", Ensemble(models)))]
    assert alone[0].join(alone[1]).to_json() == result.to_json()


def test_a_mixture_of_bounds_is_at_most_the_evidence_of_the_mixture():
    pair = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 2})
    models = surrogates(3, pair)
    x = models[0].sample(200, T)["x"]
    result = compare({"mixture": Ensemble(models)}, x, **{**QUIET, "particles": 64})
    row, evidence = result.rows["mixture"].bounds, mixed(models, x)
    assert row["ELBO"].mean() < row["IWAE bound"].mean() < evidence.mean()
    assert "KL z" not in row


class Constant(DynamicalVAE):
    """A model whose forecasts all have one value."""

    def __init__(self, value):
        super().__init__(*AUTOREGRESSIVE)
        self.value = value

    def forecast(self, batch, horizon, samples=1, **options):
        return {"x": torch.full((samples, len(batch), horizon, 2), float(self.value))}


@pytest.mark.parametrize("samples", [2, 3, 10])
def test_forecasts_are_pooled_from_all_models_equally(samples):
    ensemble, counts = Ensemble([Constant(value) for value in range(3)]), torch.zeros(3)
    torch.manual_seed(0)
    firsts = set()
    for _ in range(200):
        values = ensemble.forecast(torch.zeros(4, T, 2), 2, samples)["x"]
        assert values.shape == (samples, 4, 2, 2)
        count = torch.bincount(values[:, 0, 0, 0].long(), minlength=3)
        assert count.max() - count.min() <= 1
        counts += count / 200
        firsts.add(int(values[0, 0, 0, 0]))
    assert (counts - samples / 3).abs().max() < 0.15
    assert firsts == {0, 1, 2}


def test_forecasts_of_the_mixture_are_scored_like_those_of_a_model():
    models = surrogates()
    windows = ArrayWindows(models[0].sample(6, T)["x"], 3)
    options = {"samples": 6, "seed": 3, "progress": False}
    result = compare({"seeds": models, "mixture": Ensemble(models)}, windows, **{**QUIET, **options})
    expected = evaluate({"mixture": Ensemble(models)}, windows, references=False, **options)["mixture"]
    assert result["mixture"]["CRPS"].mean == pytest.approx(expected["CRPS"].mean)
    assert "ELBO" not in expected
    assert result["mixture"]["CRPS"].mean != result["seeds"]["CRPS"].mean


def test_models_that_differ_in_more_than_weights_are_refused():
    with pytest.raises(ValueError, match="at least one model in an ensemble"):
        Ensemble([])
    with pytest.raises(TypeError, match="has a Linear"):
        Ensemble([torch.nn.Linear(1, 1)])
    with pytest.raises(ValueError, match="must differ only in their seed"):
        Ensemble([DynamicalVAE("p(x_t | x_{t-1})", "", {"x": 2}), DynamicalVAE("p(x_t | x_{<t})", "", {"x": 2})])
