"""Which factors read covariates, gaps and static values; units of columns are a change of variables."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import dvae
from dvae.data.schema import SchemaError
from dvae.data.units import Coordinate, Units
from dvae.data.views import ContextView
from dvae.factorization.notation import Factorization
from dvae.models.registry import methods
from dvae.tables import Column, Columns, Panel, Series
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut

WITHOUT_LATENTS = ["autoregressive", "moglow"]
METHODS = ["vae", "dkf", "storn", "vrnn", "srnn", "rvae-causal", "rvae-noncausal", "dsae", "kvae", "rslds"]
METHODS += WITHOUT_LATENTS
SCHEMA = PanelSchema(
    columns=Columns((Column("y"), Column("plan", "known"), Column("height", "static"))),
    means={"y": 0.0, "plan": 0.0, "height": 0.0},
    scales={"y": 1.0, "plan": 1.0, "height": 1.0},
    step=1.0,
)


def test_factors_read_covariates_of_their_step():
    pair = Factorization.parse("p(w) p(z_t | z_{t-1}, w) p(x_t | z_t, c_{t-1})")
    extended = pair.given(["c", "d"], ["s"])
    assert extended.given(["c", "d"], ["s"]) == extended
    assert extended == Factorization.parse("p(w) p(z_t | z_{t-1}, w, c_t, d_t, s) p(x_t | z_t, c_{t-1}, d_t, s)")
    guide = Factorization.parse("q(w | x_{1:T}) q(z_t | x_{1:T})")
    assert guide.given(["c"], ["s"]) == Factorization.parse("q(w | x_{1:T}, c_{1:T}, s) q(z_t | x_{1:T}, c_t, s)")
    assert guide.given(["c"], ["s"], ["q(z)"]) == Factorization.parse("q(w | x_{1:T}, c_{1:T}, s) q(z_t | x_{1:T})")


@pytest.mark.parametrize("name", METHODS)
def test_methods_read_covariates_if_and_only_if_the_data_have_them(name):
    method = dvae.method(name, **({} if name in WITHOUT_LATENTS else {"latent": 2}))
    model = method.build(SCHEMA)
    assert {*model.context} == {"c", "d", "s"}
    for part in (model.generative, model.inference):
        for factor in part.factors if part else ():
            covariates = {parent.name for parent in factor.parents} & {"c", "d", "s"}
            assert not covariates or covariates == {"c", "d", "s"}
            if f"{factor.kind}({factor.child})" in method.without_covariates or not (factor.local or factor.parents):
                assert not covariates
    transition = next(factor for factor in model.generative.factors if factor.child in (*model.latents, "x"))
    is_read = {parent.name for parent in transition.parents} >= {"c", "d", "s"}
    # w of dsae is static, and the chains of kvae and rslds read their own past
    assert is_read == (name not in ("dsae", "kvae", "rslds"))
    assert not method.build(PanelSchema(columns=Columns((Column("y"),)))).context
    equations = methods()[name].generative
    plain = method.build({"x": 3})
    assert plain.generative == Factorization.parse(equations)


@pytest.mark.parametrize("name", [name for name in METHODS if name not in WITHOUT_LATENTS])
def test_guides_read_indicators_if_training_data_have_missing_values(name):
    """Also with `hide`. A mask without missing values changes nothing; one with missing values does."""
    x, mask = torch.randn(3, 5, 1), torch.rand(3, 5, 1) < 0.5
    for schema, options in ((replace(SCHEMA, with_missing=("y",)), {}), (SCHEMA, {"hide": 0.3})):
        model = dvae.method(name, latent=2, **options).build(schema)
        assert model.indicators == ("x",)
        batch = {"x": x, "c": torch.zeros(3, 5, 1), "s": torch.zeros(3, 1), "d": torch.ones(3, 5, 1)}
        observed, latents = torch.where(mask, x, 0.0), []
        for changes in ({}, {"mask": torch.ones_like(mask)}, {"x": observed, "mask": mask}, {"x": observed}):
            torch.manual_seed(0)
            latents.append(model.guide({**batch, **changes})[model.latents[0]])
        assert torch.equal(latents[0], latents[1])
        assert not torch.allclose(latents[2], latents[3])
    assert not dvae.method(name, latent=2).build(SCHEMA).indicators


def test_hiding_values_needs_a_description_of_the_data():
    with pytest.raises(SchemaError, match="dkf needs the description of sequences, but was given object"):
        dvae.method("dkf", hide=0.2).train(object(), None, 10)
    with pytest.raises(ValueError, match="leave hide at 0"):
        dvae.method("hit-dvae", hide=0.2)


def test_a_view_accepts_unread_context_and_does_not_return_it():
    view = ContextView(("c", "s"))
    batch = {"x": torch.randn(2, 3, 1), "c": torch.randn(2, 3, 4), "s": torch.randn(2, 1)}
    assert view(batch) == batch
    assert view.inverse(batch).keys() == {"x"}
    assert view.keeps_volume


def test_logarithms_have_a_floor_and_finite_gradients():
    units = Units(2, [Coordinate(), Coordinate(floor=0.5, level=1.0, spread=2.0)]).double()
    values = torch.tensor([[-3.0, 0.0], [0.0, 0.5], [2.0, math.e]], dtype=torch.float64, requires_grad=True)
    lowest = (math.log(0.5) - 1) / 2
    torch.testing.assert_close(units(values), torch.tensor([[-3, lowest], [0, lowest], [2, 0]], dtype=torch.float64))
    units(values).sum().backward()
    assert torch.isfinite(values.grad).all()


@pytest.mark.parametrize(
    ("family", "name"),
    [
        *((family, "autoregressive") for family in ("positive", "power", "robust")),
        *((family, "srnn") for family in ("log-normal", "real", "laplace")),
    ],
)
def test_a_change_of_unit_changes_the_density_by_its_jacobian(family, name):
    """log p(a x) = log p(x) - T log a, as networks see the same scaled values."""
    rng, scale = np.random.default_rng(0), 1e3
    values = rng.lognormal(0, 2, (6, 9, 1))
    bounds = []
    for unit in (1.0, scale):
        columns = Columns((Column("y", family=family),))
        panel = Panel([Series(f"s{n}", unit * sequence) for n, sequence in enumerate(values)], columns)
        schema = PanelSchema.from_data(panel, Cut())
        torch.manual_seed(0)
        model = dvae.method(name, **({} if name == "autoregressive" else {"latent": 2})).build(schema).double()
        torch.manual_seed(1)
        bounds.append(dvae.iwae_bound(model, torch.tensor(unit * values), particles=3).bound)
    torch.testing.assert_close(bounds[1], bounds[0] - 9 * math.log(scale), rtol=1e-5, atol=0)  # units are float32
