"""Scheduled sampling and input noise: which steps read the truth in training, and with which noise."""

import pytest
import torch
from pyro import poutine

from dvae import DynamicalVAE, InputNoise, ScheduledSampling
from dvae.inference.bounds.elbo import SequenceELBO
from dvae.networks import Attention, Recurrent
from dvae.networks.base import Network
from dvae.networks.recurrent import RecurrentNetwork

B, T, D = 3, 11, 2
NETWORKS = {
    "lstm": Recurrent(4, layers=2, hidden=()),
    "gru, embedded": Recurrent(4, cell="gru", embed=3, extract={"x": (5,)}, hidden=(6,)),
    "attention": Attention(8, heads=2),
}
PAIRS = {
    "autoregressive": ("p(x_t | x_{<t})", ""),
    "with context": ("p(x_t | x_{<t}, c_t)", ""),
    "srnn": ("p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"),
    "vrnn": ("p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{<=t}, z_{<t})"),
}
PAIRWISE = [(pair, list(NETWORKS)[place % 3]) for place, pair in enumerate(PAIRS)] + [("vrnn", "gru, embedded")]


def build(pair="autoregressive", network="lstm", **options):
    equations = PAIRS[pair]
    sizes = {name: D for name in "zxc" if f"{name}_" in "".join(equations)}
    return DynamicalVAE(*equations, sizes, NETWORKS[network], **options).double()


def draw(model):
    return {name: torch.randn(B, T, D, dtype=torch.float64) for name in (*model.observed, *model.context)}


def run(model, batch, feeding):
    """Return the rollout of a scored batch."""
    return poutine.trace(model.model).get_trace(batch, scheduled_sampling=feeding).nodes["x"]["fn"].rollout


# ------------------------------------------------------------------------------------------------------------- blocks


@pytest.mark.parametrize(("start", "n_true", "n_generated"), [(0, 1, 1), (3, 2, 3), (0, 20, 1)])
def test_blocks_alternate_between_the_truth_and_generated_means(start, n_true, n_generated):
    """The Jacobian of the mean at t is zero for replaced frames, and nonzero for all other earlier frames."""
    model, feeding = build(), ScheduledSampling(1.0, start=start, blocks=(n_true, n_generated))
    x = torch.randn(1, T, D, dtype=torch.float64)

    def means(x):
        rollout = run(model, {"x": x}, feeding)
        return rollout.parameters("x", rollout.values["x"])[0].sum((0, 2))

    is_read = torch.autograd.functional.jacobian(means, x)[:, 0].abs().sum(-1) > 0
    is_true = torch.tensor([t < start or (t - start) % (n_true + n_generated) < n_true for t in range(T)])
    assert torch.equal(is_read, torch.ones(T, T, dtype=torch.bool).tril(-1) & is_true)


@pytest.mark.parametrize(("pair", "network"), PAIRWISE)
def test_blocks_equal_parallel_passes_over_all_steps(pair, network):
    """The loop, which runs some steps at once, has the values and gradients of parallel passes."""
    model = build(pair, network)
    data = draw(model)
    results = []
    for passes in (None, T):
        torch.manual_seed(0)
        bound = (
            SequenceELBO().terms(model, data, scheduled_sampling=ScheduledSampling(1.0, passes, blocks=(3, 2))).bound
        )
        gradient = torch.autograd.grad(bound.sum(), list(model.parameters()), allow_unused=True)
        results.append((bound, gradient))
    torch.testing.assert_close(*results, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("pair", "network"), [pair for pair in PAIRWISE if pair[1] != "attention"])
def test_a_forecast_reads_observed_steps_at_once(pair, network, monkeypatch):
    """The forecast equals the one step by step, also with missing frames."""
    model = build(pair, network).eval()
    data = draw(model)
    past = {name: value if name == "c" else value[:, :7] for name, value in data.items()}
    mask = torch.ones(B, 7, D, dtype=torch.bool)
    mask[1, 3] = False
    results = []
    for _ in range(2):
        torch.manual_seed(0)
        complete = model.forecast(past, T - 7, samples=2, draw_emission=True)["x"]
        results.append((complete, model.forecast({**past, "mask": mask}, T - 7, samples=2, draw_emission=True)["x"]))
        monkeypatch.setattr(RecurrentNetwork, "forward_chunk", Network.forward_chunk)  # step by step
    torch.testing.assert_close(*results, rtol=0, atol=1e-10)


# -------------------------------------------------------------------------------------------------------------- noise


def test_inputs_have_noise_in_their_unit_and_scored_values_have_none():
    model = build("srnn")
    model.standardise("x").fit(3 + 4 * torch.randn(500, D, dtype=torch.float64))
    x = 3 + 4 * torch.randn(4000, T, D, dtype=torch.float64)
    rollout = run(model, {"x": x}, InputNoise(0.3))
    noise = rollout.history("x")["x"] - x
    assert rollout.history("z")["x"] is rollout.history("x")["x"]  # every factor reads the same history
    torch.testing.assert_close(
        noise.std((0, 1)) / model.units["x"].scale, torch.full((D,), 0.3).double(), rtol=0.02, atol=0
    )
    assert noise.mean().abs() < 0.01
    assert torch.corrcoef(noise[:, :2].flatten(1).mT)[0, 1:].abs().max() < 0.06  # each entry has its own
    values = {**rollout.values, "x": x + noise}
    expected = model.generator["x"].head.distribution(model.generator["x"](values, len(x), T)).log_prob(x)
    torch.testing.assert_close(rollout.evaluate("x", x).log_prob(x), expected, rtol=0, atol=1e-12)


def test_a_number_scales_the_scheduled_sampling_or_noise_of_the_model():
    model = build()
    model.feeding = InputNoise(0.8)
    x = torch.randn(4000, T, D, dtype=torch.float64)
    noise = run(model, {"x": x}, 0.5).history("x")["x"] - x
    assert float(noise.std()) == pytest.approx(0.4, rel=0.02)
    model.feeding = ScheduledSampling(0.0, blocks=(2, 1))
    assert run(model, {"x": x[:2]}, 1.0).feeding == ScheduledSampling(1.0, blocks=(2, 1))
