"""Families draw what their densities say: simulation-based calibration of a posterior that is known on a grid."""

import pyro
import pyro.distributions as dist
import pytest
import torch

import dvae
from dvae import distributions
from dvae.distributions import Family
from dvae.networks import Dense

LAWS = {**distributions.FAMILIES, "multivariate": Family("MultivariateNormal"), "simplex": Family("Dirichlet")}
T, SIZE, DRAWS = 5, 3, 9
EDGES = torch.linspace(-5, 5, 402, dtype=torch.float64)


def built(law):
    """w moves every parameter of the law, in the middle of its range and steadily."""
    torch.manual_seed(0)
    networks = {"p(x)": Dense((4,)), "default": Dense((2,))}
    model = dvae.DynamicalVAE("p(w) p(x_t | w)", "q(w)", {"w": 1, "x": SIZE}, networks, {"p(x)": law}).double()
    for name, parameter in model.generator["x"].named_parameters():
        parameter.data *= 2 if name.endswith("weight") else 1
    return model


def posterior(model):
    """Draws of w given x, from its density at the middles of 401 intervals, and evenly within the one that is drawn."""

    def guide(batch):
        x, middles = batch["x"].unflatten(0, (DRAWS, -1))[0], (EDGES[1:] + EDGES[:-1]) / 2  # the others are the same
        w = middles[:, None]
        parameters = model.generator["x"]({"w": w}, len(w), T)
        law = model.generator["x"].law.distribution(tuple(p[:, None] for p in parameters))  # (G, 1, T, ...)
        log_likelihood = law.log_prob(x).flatten(2).sum(-1)
        logits = log_likelihood + dist.Normal(0.0, 1.0).log_prob(w)
        chosen = dist.Categorical(logits=logits.T).sample((DRAWS,)).flatten()
        value = middles[chosen] + (torch.rand(len(chosen)) - 0.5).double() * (EDGES[1] - EDGES[0])
        with pyro.plate("sequences", len(value)):
            pyro.sample("w", dist.Delta(value[:, None]).to_event(1))

    return guide


@pytest.mark.parametrize("name", LAWS)
def test_the_posterior_is_calibrated(name):
    model = built(LAWS[name])
    found = dvae.calibrate(model, T, 400, DRAWS, guide=posterior(model), progress=False)
    assert found.p_value > 1e-3
