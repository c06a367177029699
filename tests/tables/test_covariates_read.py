"""Who reads covariates, gaps and statics, and that the units of columns are a change of variables."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import dvae
from dvae.models.registry import methods
from dvae.notation import Factorization
from dvae.tables import Column, Columns
from dvae.tables.encoding import PanelSchema
from dvae.units import Units
from dvae.views import Offered

METHODS = ["vae", "dkf", "storn", "vrnn", "srnn", "rvae-causal", "rvae-noncausal", "dsae", "kvae", "autoregressive"]
SCHEMA = PanelSchema(
    columns=Columns((Column("y"), Column("plan", "known"), Column("height", "static"))),
    means={"y": 0.0, "plan": 0.0, "height": 0.0},
    scales={"y": 1.0, "plan": 1.0, "height": 1.0},
    step=1.0,
)


def test_factors_read_what_is_given_at_their_step():
    pair = Factorization.parse("p(w) p(z_t | z_{t-1}, w) p(x_t | z_t, c_{t-1})")
    found = pair.given(["c", "d"], ["s"])
    assert found == Factorization.parse("p(w) p(z_t | z_{t-1}, w, c_t, d_t, s) p(x_t | z_t, c_{t-1}, d_t, s)")
    guide = Factorization.parse("q(w | x_{1:T}) q(z_t | x_{1:T})")
    assert guide.given(["c"], ["s"]) == Factorization.parse("q(w | x_{1:T}, c_{1:T}, s) q(z_t | x_{1:T}, c_t, s)")
    assert guide.given(["c"], ["s"], ["q(z)"]) == Factorization.parse("q(w | x_{1:T}, c_{1:T}, s) q(z_t | x_{1:T})")


def test_what_is_given_twice_is_read_once():
    pair = Factorization.parse("p(z_t | z_{t-1}) p(x_t | z_t)").given(["c"], ["s"])
    assert pair.given(["c"], ["s"]) == pair
    assert pair.given([], []) == pair


@pytest.mark.parametrize("name", METHODS)
def test_methods_read_covariates_where_data_have_them_and_only_then(name):
    method = dvae.method(name, **({} if name == "autoregressive" else {"latent": 2}))
    model = method.build(SCHEMA)
    assert {*model.context} == {"c", "d", "s"}
    for part in (model.generative, model.inference):
        for factor in part.factors if part else ():
            read = {parent.name for parent in factor.parents} & {"c", "d", "s"}
            assert not read or read == {"c", "d", "s"}
            if f"{factor.kind}({factor.child})" in method.apart or not (factor.local or factor.parents):
                assert not read
    assert not method.build(PanelSchema(columns=Columns((Column("y"),)))).context
    written = methods()[name].generative
    plain = method.build({"x": 3})
    assert plain.generative == Factorization.parse(written)


def test_context_that_a_model_does_not_read_may_be_there_and_does_not_come_back():
    view = Offered(("c", "s"))
    batch = {"x": torch.randn(2, 3, 1), "c": torch.randn(2, 3, 4), "s": torch.randn(2, 1)}
    assert view(batch) == batch
    assert view.inverse(batch).keys() == {"x"}
    assert view.keeps_volume


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(1e-3, 1e3)), min_size=1, max_size=5), st.integers(1, 4))
def test_units_of_columns_are_a_change_of_variables(told, steps):
    units = Units(len(told), columns=True).double()
    means, scales = zip(*told, strict=True)
    units.set(means, scales, means)
    values = torch.randn(2, steps, len(told), dtype=torch.float64)
    torch.testing.assert_close(units.inverse(units(values)), values, rtol=0, atol=1e-9)
    jacobian = torch.autograd.functional.jacobian(
        lambda flat: units(flat.view(1, steps, -1)).flatten(), values[0].flatten()
    )
    torch.testing.assert_close(units.log_det(values), jacobian.slogdet().logabsdet.expand(2))


def test_units_of_columns_are_fitted_to_each():
    values = torch.randn(200, 5, 3, dtype=torch.float64) * torch.tensor([0.1, 1.0, 100.0]) + torch.tensor(
        [5.0, 0.0, -7.0]
    )
    units = Units(3, columns=True).double()
    units.fit(values)
    seen = units(values).flatten(0, 1)
    torch.testing.assert_close(seen.mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(seen.var(0), torch.ones(3, dtype=torch.float64))
