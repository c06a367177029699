"""Wrong arguments of bounds, diagnostics, evaluation and training are errors."""

import math

import pytest
import torch
from pyro import poutine
from torch import nn

import dvae
from dvae import DynamicalVAE, SequenceELBO, linear_gaussian_surrogate
from dvae.data.sequences import ArrayWindows
from dvae.inference.bounds.predictive import predictive_bound
from dvae.inference.bounds.probe import RedrawnModel
from dvae.inference.diagnostics.checks import Statistic, predictive_checks
from dvae.inference.diagnostics.traversal import traverse
from dvae.inference.evaluation import metrics
from dvae.inference.evaluation.conformal import conformal_bands
from dvae.inference.evaluation.estimates import TwoWayErrors
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.multiple_comparisons import confidence_set, required
from dvae.inference.evaluation.references import nearest_neighbours, seasonal
from dvae.inference.evaluation.scores import CRPS, ENERGY, by_column, coverage_at
from dvae.inference.training.gradnorm import GradNorm
from dvae.inference.training.objectives import Evidence
from dvae.inference.training.options import Training
from dvae.inference.training.schedules import Logistic, Piecewise, Ramp, from_config, schedule, to_config
from dvae.networks import Linear

T = 4
DKF = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})")
MODEL = linear_gaussian_surrogate(*DKF, {"z": 1, "x": 1}, T).requires_grad_(False)
SEEN = DynamicalVAE("p(x_t | x_{t-1})", "", {"x": 1}).double()
SUMMED = DynamicalVAE("p(k_t | k_{t-1}) p(x_t | k_t)", "", {"k": dvae.Discrete(2), "x": 1}).double()
X = torch.zeros(2, T, 1, dtype=torch.float64)
RAGGED = {"x": X, "lengths": torch.tensor([T, 2])}
WINDOWS = ArrayWindows(X, 2)
SAMPLES, TRUTH = torch.zeros(5, 4, 3), torch.zeros(4, 3)
ONE = TwoWayErrors.of(torch.zeros(1, 4).numpy(), torch.ones(4).numpy())


def fit(model=MODEL, data=X, **options):
    return dvae.fit(model, data, steps=1, progress=False, **options)


def checks(*statistics, **options):
    return predictive_checks(MODEL, WINDOWS, *statistics, progress=False, **options)


def reference(**options):
    return dvae.reference_posterior(MODEL, X, progress=False, **options)


def run(function, *arguments, **options):
    return function(*arguments, progress=False, **options)


def ordered(p, q):
    names = dvae.Factorization.parse(p).variables
    return dvae.fivo_bound(DynamicalVAE(p, q, dict.fromkeys(names, 1), Linear(T)).double(), X)


BOUNDS = [
    (lambda: SequenceELBO().terms(poutine.scale(MODEL.model, scale=0.5), X, MODEL.guide), "scaled"),
    (lambda: SequenceELBO().terms(MODEL.model, X, poutine.block(MODEL.guide, hide=["z"])), "not in the guide"),
    (lambda: SequenceELBO().terms(poutine.block(MODEL.model, hide=["z"]), X, MODEL.guide), "not in the model"),
    (lambda: dvae.annealed_bound(MODEL, X, 0), "at least 1"),
    (lambda: dvae.annealed_bound(MODEL, X, 2, latents={}), "missing"),
    (lambda: dvae.annealed_bound(MODEL, X, 2, latents={"z": X[:, :2]}), "shape"),
    (lambda: dvae.annealed_bound(MODEL, X[:0], 2), "no sequences"),
    (lambda: dvae.annealed_bound(SEEN, X, 2), "latent"),
    (lambda: dvae.iwae_bound(MODEL, X, 0), "at least 1"),
    (lambda: dvae.semi_amortized_guide(MODEL, X, steps=0), "at least 1"),
    (lambda: dvae.semi_amortized_guide(SEEN, X), "latent"),
    (lambda: dvae.fivo_bound(MODEL, X, 0), "at least 1"),
    (lambda: dvae.fivo_bound(MODEL, X, resample_below=1.5), "share"),
    (lambda: dvae.fivo_bound(SUMMED, X), "summed out"),
    (lambda: ordered(DKF[0], "q(z_t | z_{t+1}, x_t)"), "backward"),
    (lambda: ordered("p(z_t) p(x_t | z_{1:T})", "q(z_t | z_{<t}, x_t)"), "reads"),
    (lambda: ordered("p(w) p(z_t | w) p(x_t | z_t)", "q(w | z_{1:T}) q(z_t | x_t)"), "draws after"),
    (lambda: predictive_bound(MODEL, X, 0, 1), "observed"),
    (lambda: predictive_bound(MODEL, RAGGED, 2), "lengths"),
    (lambda: RedrawnModel(MODEL, {}), "none"),
    (lambda: RedrawnModel(MODEL, {"z": torch.distributions.Normal(0.0, 1.0)}), "depends on"),
]
DIAGNOSTICS = [
    (lambda: run(dvae.bracket, MODEL, X, particles=0), "at least 1"),
    (lambda: run(dvae.bracket, SEEN, X), "latent"),
    (lambda: run(dvae.bracket, SUMMED, X), "summed out"),
    (lambda: run(dvae.calibrate, MODEL, T, 0), "at least 1"),
    (lambda: run(dvae.calibrate, MODEL, T, 5, steps=[2, 2]), "different"),
    (lambda: run(dvae.calibrate, MODEL, T, 5, guide=lambda batch: None), "no site"),
    (lambda: run(dvae.calibrate, MODEL, T, 5).envelope(1.0), "alpha"),
    (lambda: checks(samples=18), "samples"),
    (lambda: checks({}), "statistic"),
    (lambda: checks({"all": Statistic(lambda x: x.mean())}), "one number"),
    (lambda: checks({"gap": Statistic(lambda x: x[..., 9:, 0].mean(-1))}), "finite"),
    (lambda: reference(sequences=[2]), "sequences"),
    (lambda: reference(draws=3), "draws"),
    (lambda: reference(guide=lambda batch: None), "no site"),
    (lambda: traverse(MODEL, X, "v"), "must be one"),
    (lambda: traverse(MODEL, X, "z", free=["z"]), "free"),
    (lambda: traverse(MODEL, X, "z", coordinates=[2]), "coordinates"),
    (lambda: traverse(MODEL, X, "z", unit="metre"), "unit"),
    (lambda: traverse(MODEL, X, "z", steps=6), "offsets"),
]
EVALUATION = [
    (lambda: run(dvae.compare, {}, X), "models"),
    (lambda: run(dvae.compare, MODEL, X), "mapping"),
    (lambda: run(dvae.compare, {"a": 3}, X), "int"),
    (lambda: run(dvae.compare, {"a": nn.Linear(2, 2)}, X), "Linear"),
    (lambda: run(dvae.compare, {"a": MODEL}, X, particles=0), "at least 1"),
    (lambda: run(dvae.compare, {"a": [MODEL, linear_gaussian_surrogate(*DKF, {"z": 2, "x": 1}, T)]}, X), "seed"),
    (lambda: run(conformal_bands, MODEL, WINDOWS), "at least 9 sequences"),
    (lambda: run(conformal_bands, MODEL, WINDOWS, 1), "between"),
    (lambda: run(evaluate, {}, WINDOWS, samples=0), "samples"),
    (lambda: run(evaluate, {}, WINDOWS, scores="motion"), "scores"),
    (lambda: run(evaluate, {}, WINDOWS, scores=lambda _: [ENERGY, ENERGY]), "several"),
    (lambda: run(evaluate, {"a": nn.Linear(1, 1)}, WINDOWS), "Linear"),
    (lambda: ArrayWindows(X, T), "observed"),
    (lambda: ArrayWindows(X[0], 2), "must be"),
    (lambda: nearest_neighbours(X[:, :2], X, 5), "neighbours"),
    (lambda: nearest_neighbours(X[:, :2], X[:, :2], 1), "observed"),
    (lambda: seasonal(X, 3, 0), "season"),
    (lambda: coverage_at(1), "between"),
    (lambda: by_column(CRPS, {"a": "", "b": ""})[0].function(X[:, None], X, {"x": X}, torch.arange(2)), "columns"),
    (lambda: metrics.coverage(SAMPLES, TRUTH, 1), "between"),
    (lambda: metrics.pit_histogram(SAMPLES, TRUTH, 0), "bin"),
    (lambda: metrics.probability_integral_transform(SAMPLES, TRUTH, torch.zeros(4)), "uniform"),
    (lambda: metrics.frechet_distance(torch.zeros(1, 3), TRUTH), "at least 2"),
    (lambda: metrics.average_pairwise_distance(TRUTH), "axis"),
    (lambda: metrics.average_pairwise_distance(SAMPLES[:0]), "size 0"),
    (lambda: metrics.variogram_score(SAMPLES, TRUTH, order=0), "order"),
    (lambda: confidence_set({}), "models"),
    (lambda: confidence_set({"a": ONE}, level=1.0), "between"),
    (lambda: confidence_set({"a": ONE}), "seed"),
    (lambda: required(ONE, ONE), "seeds"),
]
TRAINING = [
    (lambda: fit(), "gradients"),
    (lambda: fit(3), "module"),
    (lambda: fit(SEEN, objective=Evidence), "class"),
    (lambda: fit(SEEN, X[0]), "expected"),
    (lambda: fit(SEEN, {"x": X, "w": X[:1, 0]}), "number"),
    (lambda: fit(SEEN, X[:0]), "at least one"),
    (lambda: fit(SEEN, X * math.nan), "infinite"),
    (lambda: fit(SEEN, objective=GradNorm(("x", "z"), "generator")), "includes"),
    (lambda: GradNorm(("x", "x"), "generator"), "different names"),
    (lambda: GradNorm("x", "generator"), "tuple"),
    (lambda: GradNorm(("x", "y"), "generator", asymmetry=-1.0), "asymmetry"),
    (lambda: from_config({"schedule": "Exponential", "rate": 0.1}), "schedules"),
    (lambda: from_config({"schedule": "Ramp", "begin": 0.0}), "takes"),
    (lambda: to_config(object()), "schedules"),
    (lambda: schedule("0.1"), "expected"),
    (lambda: Ramp(0.0, 1.0, steps=0), "at least"),
    (lambda: Logistic(0.0, 1.0, steps=5, steepness=0.0), "at least"),
    (lambda: Piecewise(((5, 1.0), (4, 0.0))), "needs"),
    *(
        (lambda options=options: Training(**options), "must|set|leave|unknown")
        for options in (
            {"steps": 0},
            {"steps": 2.5},
            {"patience": 0},
            {"gradient_clip": math.nan},
            {"optimizer": "lion"},
            {"decay": 1.5},
            {"learning_rate": -1},
            {"learning_rate": "fast"},
            {"scheduled_sampling": 2},
            {"momentum": 0.9},
            {"weight_decay": -1.0},
            {"optimizer": "sgd", "momentum": 1.0},
            {"decay": 0.5, "learning_rate": Ramp(1e-3, 0.0, 10)},
        )
    ),
]


@pytest.mark.parametrize(
    "table", [BOUNDS, DIAGNOSTICS, EVALUATION, TRAINING], ids=["bounds", "diagnostics", "evaluation", "training"]
)
def test_misuse_is_an_error(table):
    for call, word in table:
        with pytest.raises((TypeError, ValueError), match=word):
            call()
