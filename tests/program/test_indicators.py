"""Guides read indicators of the observed entries that they read, and no others."""

import pytest
import torch

import dvae
from dvae.data.sequences import RandomMasking, Sequences
from dvae.distributions import FixedNormal
from dvae.networks import Attention, Linear, Recurrent
from dvae.networks.base import indicator
from dvae.testing import FactorizationContract

PAIR = "p(w) p(z_t | z_{t-1}, x_{t-1}, w) p(x_t | z_t)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{t-1:t+1}, w)"
SIZES = {"w": 2, "z": 2, "x": 2}


def model(network=None, guide=PAIR[1], indicators=("x",), **options):
    distributions = {"p(x)": FixedNormal(0.3), **options.pop("distributions", {})}
    network = network or Recurrent(5, hidden=(4,))
    guided_model = dvae.DynamicalVAE(PAIR[0], guide, SIZES, network, distributions, indicators=indicators, **options)
    return guided_model.double().eval()


class TestModel(FactorizationContract):
    test_its_linear_gaussian_surrogate_is_bounded_by_the_evidence_and_tight_where_the_audit_says_so = (
        None  # of equations
    )

    def build(self, size):
        pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})"
        return dvae.DynamicalVAE(*pair, {"z": size, "x": size}, Recurrent(5, hidden=(4,)), indicators=("x",))


@pytest.mark.parametrize("network", [Recurrent(5, hidden=(4,), extract={"x": (3,)}), Attention(8, 2), Linear(6)])
@pytest.mark.parametrize("relation", ["<t", "t-1:t+1"])
def test_an_indicator_is_read_if_and_only_if_its_entry_is(network, relation):
    guided_model = model(network, f"q(w | x_{{1:T}}) q(z_t | z_{{t-1}}, x_{{{relation}}}, w)")
    values = {"x": torch.randn(1, 6, 2), "z": torch.randn(1, 6, 2), "w": torch.randn(1, 2)}
    values = {name: value.double() for name, value in values.items()}
    for name, rows in (("z", 6), ("w", 1)):
        conditional = guided_model.encoder[name]

        def parameters(indicators, conditional=conditional, rows=rows):
            parts = conditional({**values, indicator("x"): indicators}, 1, 6)
            return torch.cat(parts, -1).reshape(rows, -1) @ torch.linspace(1, 2, 4).double()

        jacobian = torch.autograd.functional.jacobian(parameters, torch.ones(1, 6, 2).double())
        is_read = torch.as_tensor(conditional.factor.mask("x", 6)).expand(rows, 6)
        assert torch.equal((jacobian[:, 0] != 0).any(-1), is_read)


# --------------------------------------------------------------------------------------------------- hidden entries


def test_the_given_share_of_entries_is_hidden_and_events_are_hidden_together():
    x, observed = torch.randn(50, 40, 5), torch.rand(50, 40, 5) < 0.9
    source = RandomMasking(Sequences({"x": x, "mask": observed}), 0.3, (0, 1, 1, 2, 2))
    batch, repeated = (source.sample(50, torch.Generator().manual_seed(0)) for _ in range(2))
    assert torch.equal(batch["mask"], repeated["mask"])
    plain = RandomMasking(Sequences({"x": x}), 0.3, (0, 1, 1, 2, 2)).sample(50, torch.Generator().manual_seed(0))
    hidden = ~plain["mask"]
    assert torch.equal(hidden[..., 1], hidden[..., 2])
    assert torch.equal(hidden[..., 3], hidden[..., 4])
    for index in (0, 1, 3):
        assert abs(hidden[..., index].double().mean() - 0.3) < 4 * (0.3 * 0.7 / 2000) ** 0.5
    steps = hidden.all(-1).double().mean()
    expected = 1 - 0.7**0.5 * (1 - (1 - 0.7**0.5) ** 3)
    assert abs(steps - expected) < 4 * (expected * (1 - expected) / 2000) ** 0.5
    assert not (batch["mask"] & hidden).any()
