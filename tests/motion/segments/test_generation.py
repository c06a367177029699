"""Segments from the prior: statistics of known motions, given durations, and the aggregate posterior."""

import math

import pytest
import torch
from pyro import distributions as dist

import dvae
from dvae import motion
from dvae.motion.segments.dataset import SegmentData
from dvae.motion.segments.embodied import SHAPE
from dvae.motion.segments.generation import Generated, aggregate_posterior, generate, summarise


@pytest.fixture(scope="module")
def segments():
    return SegmentData("simulated", motion.simulate(clips=10, frames=60, seed=1), "clips").windows("train")


@pytest.fixture
def model(segments):
    torch.manual_seed(0)
    return dvae.method("motion-latent", latent=3, widths=(8,)).build(segments).double().eval()


def of_data(model, segments):
    batch = segments.all()
    return Generated(model, batch["x"].double(), batch[SHAPE].double())


def test_statistics_of_a_body_that_glides_without_moving(segments, model):
    """The root moves evenly along z by 2 m in 1 s; all joints have this speed, and no foot is in contact."""
    timed = model.timed
    x = torch.zeros(2, timed.frames, timed.size, dtype=torch.float64)
    even = torch.linspace(0, 1, timed.frames).double()
    x[..., timed.parts["translation"][2]] = 2 * even / timed.metres
    x[..., -1] = 1 / timed.seconds
    gliding = Generated(model, x, torch.zeros(2, 8).double())
    expected = {"duration (s)": 1.0, "displacement (m)": 2.0, "speed (m/s)": 2.0, "peak speed (m/s)": 2.0}
    expected |= {"contact (%)": 0.0, "sliding (m/s)": 2.0, "floor (cm)": 0.0, "bone stretch (%)": 0.0}
    for name, value in expected.items():
        torch.testing.assert_close(gliding.statistics[name], torch.full((2,), value).double(), atol=1e-5, rtol=1e-5)
    assert gliding.diversity == 0
    still = Generated(model, x.clone().index_fill(-1, torch.tensor(timed.parts["translation"]), 0.0), gliding.shape)
    torch.testing.assert_close(still.statistics["contact (%)"], torch.full((2,), 100.0).double())


def test_real_segments_are_plausible_and_others_are_not(segments, model):
    real = of_data(model, segments)
    summary = summarise({"real": real, "prior": generate(model, real.shape)}, real)
    assert summary["real"]["plausible (%)"] > 0  # of seven segments, each statistic excludes the two extremes
    assert summary["prior"]["plausible (%)"] == 0  # an untrained model
    joints = real._joints(real.x).flatten(1)
    assert summary["real"]["APD (m)"] == pytest.approx(float(torch.pdist(joints).mean()))


def test_durations_are_drawn_from_the_prior_given_the_duration(segments, model):
    shape = torch.zeros(8, 8)
    free = generate(model, shape.repeat(20, 1), seed=1).statistics["duration (s)"]
    target, tolerance = float(free.median()), float(free.std() / 4)
    given = generate(model, shape, seconds=target, tolerance=tolerance, seed=2).statistics["duration (s)"]
    assert ((given - target).abs() <= tolerance).all()
    with pytest.raises(ValueError, match="draws from the prior last 30"):
        generate(model, shape, seconds=30.0)


def test_the_aggregate_posterior_is_compared_with_the_prior(segments):
    """A guide whose means have the covariance that its variances lack matches the prior."""
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    means = (means - means.mean(0)) @ torch.linalg.inv(torch.linalg.cholesky(torch.cov(means.T, correction=0))).T
    for deviation in (0.6, 0.1):
        spread = (1 - 0.6**2) ** 0.5
        posterior = dist.Normal(spread * means, deviation)
        model = torch.nn.Linear(1, 1)
        model.posterior = lambda batch, posterior=posterior: posterior
        found = aggregate_posterior(model, {"x": torch.zeros(1)})
        kl = torch.distributions.kl_divergence(posterior, dist.Normal(torch.zeros(3).double(), 1.0)).sum(-1).mean()
        assert found["KL"] == pytest.approx(float(kl))
        assert found["norm"] == pytest.approx(float((spread * means).norm(dim=1).mean()))
        assert found["excess"] == pytest.approx(float(kl) - math.log(4000))
        variance = spread**2 + deviation**2
        assert found["radius"] == pytest.approx(variance**0.5)
        expected = 1.5 * (variance - 1 - math.log(variance))
        assert found["aggregate KL"] == pytest.approx(float(expected), abs=1e-9)
