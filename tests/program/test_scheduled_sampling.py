"""What stands in for the data's history in training: which steps read the truth, and what noise they read it with."""

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
    """The rollout of a scored batch."""
    return poutine.trace(model.model).get_trace(batch, scheduled_sampling=feeding).nodes["x"]["fn"].rollout


# ------------------------------------------------------------------------------------------------------------- blocks


@pytest.mark.parametrize(("start", "kept", "own"), [(0, 1, 1), (3, 2, 3), (0, 20, 1)])
def test_blocks_of_the_truth_are_read_and_blocks_of_own_means_are_not(start, kept, own):
    """The mean at t has a Jacobian of zero to every frame that was replaced, and to none before t that was not."""
    model, feeding = build(), ScheduledSampling(1.0, start=start, blocks=(kept, own))
    x = torch.randn(1, T, D, dtype=torch.float64)

    def means(x):
        rollout = run(model, {"x": x}, feeding)
        return rollout.parameters("x", rollout.values["x"])[0].sum((0, 2))

    read = torch.autograd.functional.jacobian(means, x)[:, 0].abs().sum(-1) > 0
    shown = torch.tensor([t < start or (t - start) % (kept + own) < kept for t in range(T)])
    assert torch.equal(read, torch.ones(T, T, dtype=torch.bool).tril(-1) & shown)


@pytest.mark.parametrize(("pair", "network"), PAIRWISE)
def test_blocks_are_what_as_many_passes_as_steps_make_of_them(pair, network):
    """The loop, some of whose steps are taken at once, has the values and the gradients of the parallel way."""
    model = build(pair, network)
    data = draw(model)
    found = []
    for passes in (None, T):
        torch.manual_seed(0)
        bound = (
            SequenceELBO().terms(model, data, scheduled_sampling=ScheduledSampling(1.0, passes, blocks=(3, 2))).bound
        )
        gradient = torch.autograd.grad(bound.sum(), list(model.parameters()), allow_unused=True)
        found.append((bound, gradient))
    torch.testing.assert_close(*found, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("pair", "network"), [pair for pair in PAIRWISE if pair[1] != "attention"])
def test_a_forecast_takes_what_was_observed_at_once(pair, network, monkeypatch):
    """And is the same as step by step, where frames lack entries too."""
    model = build(pair, network).eval()
    data = draw(model)
    past = {name: value if name == "c" else value[:, :7] for name, value in data.items()}
    mask = torch.ones(B, 7, D, dtype=torch.bool)
    mask[1, 3] = False
    found = []
    for _ in range(2):
        torch.manual_seed(0)
        whole = model.forecast(past, T - 7, samples=2, draw_emission=True)["x"]
        found.append((whole, model.forecast({**past, "mask": mask}, T - 7, samples=2, draw_emission=True)["x"]))
        monkeypatch.setattr(RecurrentNetwork, "forward_chunk", Network.forward_chunk)  # step by step
    torch.testing.assert_close(*found, rtol=0, atol=1e-10)


# -------------------------------------------------------------------------------------------------------------- noise


def test_what_is_read_has_noise_in_its_unit_and_what_is_scored_has_none():
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
    known = {**rollout.values, "x": x + noise}
    expected = model.generator["x"].head.distribution(model.generator["x"](known, len(x), T)).log_prob(x)
    torch.testing.assert_close(rollout.evaluate("x", x).log_prob(x), expected, rtol=0, atol=1e-12)


def test_a_number_is_a_level_of_how_the_model_is_fed():
    model = build()
    model.feeding = InputNoise(0.8)
    x = torch.randn(4000, T, D, dtype=torch.float64)
    noise = run(model, {"x": x}, 0.5).history("x")["x"] - x
    assert float(noise.std()) == pytest.approx(0.4, rel=0.02)
    model.feeding = ScheduledSampling(0.0, blocks=(2, 1))
    assert run(model, {"x": x[:2]}, 1.0).feeding == ScheduledSampling(1.0, blocks=(2, 1))
