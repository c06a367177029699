"""The bound of repeating the last value: its definition, and the warning of a fit that is worse."""

import dataclasses
import math

import numpy as np
import pytest
import torch

import dvae
from dvae.data.sequences import ArrayWindows, sequences
from dvae.inference.training.last_value import last_value_bound

T, OBSERVED = 6, 3
LAWS = {
    "real": dvae.distributions.FixedNormal(),
    "residual": dvae.distributions.FixedNormal(residual=1.0),
    "class": dvae.distributions.FAMILIES["category"],
    "count": dvae.distributions.FAMILIES["count"],
}


def model(distribution="real", size=2):
    return dvae.DynamicalVAE(
        "p(x_t | x_{<t})", "", {"x": size}, dvae.networks.Recurrent(2), {"p(x)": LAWS[distribution]}
    )


def by_definition(train, x, mask, fed):
    """Return the bound as a sum over entries."""
    mean, scale, total = train.mean((0, 1)), train.std((0, 1)), 0.0
    for n, t, d in np.argwhere(mask):
        before = [s for s in range(t) if mask[n, s, d] and not (fed and (t < OBSERVED or s >= OBSERVED))]
        location, spread = (mean[d], scale[d])
        if before:
            lag = t - before[-1]
            spread = np.sqrt(np.square(train[:, lag:, d] - train[:, :-lag, d]).mean())
            location = x[n, before[-1], d]
        total -= 0.5 * ((x[n, t, d] - location) / spread) ** 2 + np.log(spread) + 0.5 * np.log(2 * np.pi)
    return total


@pytest.mark.parametrize("fed", [False, True])
def test_the_bound_equals_its_definition_with_missing_entries_and_lengths(fed):
    random = np.random.default_rng(0)
    train, x = (random.normal(size=(n, T, 2)).cumsum(1) + 5 for n in (20, 4))
    mask, lengths = random.random(x.shape) < 0.7, np.array([T, 4, T, 2])
    valid = (np.arange(T) < lengths[:, None])[..., None]
    batch = {"x": torch.from_numpy(x), "mask": torch.from_numpy(mask), "lengths": torch.from_numpy(lengths)}
    source = sequences(train)
    bound = last_value_bound(model(), source, sequences(batch), OBSERVED, fed=fed, batch_size=3)
    batch_x = source.sample(128, torch.Generator().manual_seed(0))["x"].numpy()
    assert bound == pytest.approx(by_definition(batch_x, x, mask & valid, fed) / lengths.sum())


def test_a_worse_fit_reports_both_bounds():
    walks = torch.randn(60, T, 1).cumsum(1) + 20
    for x, worse in ((walks, True), (torch.randn(60, T, 1), False)):
        train, validation = (ArrayWindows(part, OBSERVED) for part in (x[:40], x[40:]))
        fit = dvae.fit(model(size=1), train, validation, steps=1, progress=False)
        assert fit.last_value is not None
        assert ("worse than repeating the last value" in fit.best) == worse == (fit.best_bound < fit.last_value)
        assert (f"({fit.last_value:.3f})" in fit.best) == worse
        assert ("try residual=1" in fit.best, "try scheduled_sampling=1" in fit.best) == (worse, worse)
    windows = ArrayWindows(walks, OBSERVED)
    fit_result = dvae.fit(model("residual", size=1), windows, windows, steps=1, scheduled_sampling=1.0, progress=False)
    assert "best bound with scheduled sampling" in fit_result.best
    assert "try " not in dataclasses.replace(fit_result, last_value=math.inf).best  # the run has both options
    assert dvae.fit(model(size=1), walks[:40], walks[40:], steps=1, progress=False).last_value is None
