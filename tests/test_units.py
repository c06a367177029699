"""Units: networks read and make variables without unit; values and densities keep theirs."""

import pytest
import torch
from pyro import poutine

import dvae
from dvae.networks import Attention, Recurrent
from dvae.units import Coordinate, Units

PAIR = ("p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)")
SIZES = {"w": 2, "z": 2, "x": 3}


def test_fitted_units_leave_mean_zero_and_mean_variance_one():
    units, values = Units(3).double(), torch.tensor([1.0, -2.0, 5.0]) + torch.randn(7, 40, 3, dtype=torch.float64)
    units.fit(values)
    rows = units(values).flatten(0, 1)
    torch.testing.assert_close(rows.mean(0), torch.zeros(3, dtype=torch.float64))
    assert rows.var(0).mean().item() == pytest.approx(1)
    before, after = (v[0, :20] - v[0, 20:] for v in (values, units(values)))
    torch.testing.assert_close(torch.cosine_similarity(before, after), torch.ones(20, dtype=torch.float64))


@pytest.mark.parametrize(("shape", "fill"), [((4, 2), None), ((4, 3), 1.0)])
def test_units_come_from_values_that_vary(shape, fill):
    values = torch.randn(shape) if fill is None else torch.full(shape, fill)
    with pytest.raises(ValueError, match=r"units come from values \(\.\.\., 3\) that vary"):
        Units(3).fit(values)


def test_units_that_were_given_are_not_fitted():
    with pytest.raises(ValueError, match="units of their own, which were given"):
        Units(2, [Coordinate(1.0, 2.0), Coordinate()]).fit(torch.randn(4, 2))


@pytest.mark.parametrize("network", [Attention(8, heads=2), Recurrent(4)])
@pytest.mark.parametrize(
    "law", [dvae.laws.Normal(residual=0.5), dvae.laws.FixedNormal(0.3, learned=True), dvae.laws.StudentT()]
)
def test_a_standardised_model_is_the_same_model_of_standardised_data(network, law):
    """log p(x) = log p(u) - T D log s for u = (x - m) / s, with the guide's draws the same."""
    torch.manual_seed(0)
    plain = dvae.DynamicalVAE(*PAIR, SIZES, network, {"p(x)": law}).double()
    torch.manual_seed(0)
    model = dvae.DynamicalVAE(*PAIR, SIZES, network, {"p(x)": law}).double()
    units = model.standardise("x").double()
    x = 4 + 0.1 * torch.randn(5, 6, 3, dtype=torch.float64)
    units.fit(x)
    torch.manual_seed(1)
    latents = model.guide(x)
    torch.manual_seed(1)
    same = plain.guide(units(x))
    for name in latents:
        torch.testing.assert_close(latents[name], same[name])
    ours, theirs = model.log_joint(x, latents), plain.log_joint(units(x), same)
    torch.testing.assert_close(ours["z"], theirs["z"])
    log_det = -x[0].numel() * units.scale.log()
    torch.testing.assert_close(ours["x"], theirs["x"] + log_det)
    mask = torch.rand_like(x) < 0.7
    found = []
    for each, data in ((model, x), (plain, units(x))):
        torch.manual_seed(3)
        found.append((each.guide({"x": data, "mask": mask})["z"], dvae.particle_bound(each, data, particles=3).bound))
    (z, bound), (same_z, same_bound) = found
    torch.testing.assert_close(z, same_z)
    torch.testing.assert_close(bound, same_bound + log_det)
    torch.manual_seed(2)
    future = model.forecast(x[:, :3], 4, 2)["x"]
    torch.manual_seed(2)
    torch.testing.assert_close(units(future), plain.forecast(units(x)[:, :3], 4, 2)["x"])


def test_a_scale_that_is_given_is_in_the_variables_own_unit():
    model = dvae.DynamicalVAE(*PAIR, SIZES, laws={"p(x)": dvae.laws.FixedNormal(0.3)})
    x = 4 + 0.1 * torch.randn(5, 6, 3)
    model.standardise("x").fit(x)
    site = poutine.trace(model.model).get_trace(x).nodes["x"]
    assert torch.allclose(site["fn"].steps(x).scale, torch.tensor(0.3))


def test_only_variables_have_units():
    with pytest.raises(ValueError, match="no variable 'y'; there are w, z, x"):
        dvae.DynamicalVAE(*PAIR, SIZES).standardise("y")
