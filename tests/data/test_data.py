"""Protocols of data, and the data that functions accept."""

import numpy as np
import pandas as pd
import pytest
import torch
from typing_extensions import get_protocol_members

import dvae
from dvae.data.batch import Batch
from dvae.data.sequences import (
    ArrayWindows,
    Batched,
    Fingerprinted,
    HeldOutWindows,
    Listed,
    Source,
    sequences,
)
from dvae.inference.training.objectives import RequiresDraws
from dvae.program.protocols import Forecasting, Program
from dvae.tables import Panel


@pytest.mark.parametrize(
    "protocol", [Source, Listed, Batched, Fingerprinted, HeldOutWindows, Program, Forecasting, RequiresDraws]
)
def test_a_check_of_a_protocol_reads_no_property(protocol):
    properties_read = []
    members = {
        name: property(lambda _, name=name: properties_read.append(name)) for name in get_protocol_members(protocol)
    }
    assert isinstance(type("Whole", (), members)(), protocol)
    members.popitem()
    assert not isinstance(type("Part", (), members)(), protocol)
    assert not properties_read, f"this check would compute a fingerprint: {properties_read}"


@pytest.mark.parametrize("is_dict", [False, True])
def test_a_past_contains_no_future_frame_except_context(is_dict):
    x, mask, context = torch.randn(2, 7, 3), torch.rand(2, 7, 3) < 0.5, torch.randn(2, 7, 1)
    mask = {"x": mask} if is_dict else mask
    batch = Batch(x=x, mask=mask, view_inputs={"turns": x}, y=context, w=torch.randn(2, 4))
    past, full = batch.past(5).leaves(), batch.leaves()
    assert past.keys() == full.keys()
    for name, value in past.items():
        assert torch.equal(value, full[name] if name in ("y", "w") else full[name][:, :5])


# What functions accept as data

X = torch.randn(20, 6, 3, generator=torch.Generator().manual_seed(0))
FRAME = pd.DataFrame(X.flatten(0, 1).numpy(), columns=["a", "b", "c"])
FRAME.insert(0, "step", list(range(6)) * 20)
FRAME.insert(0, "unit", np.repeat([f"u{n}" for n in range(20)], 6))
QUIET = {"progress": False}
METHOD = dvae.method("vae", latent=2, warm_up=0)


@pytest.fixture(scope="module")
def model():
    with torch.random.fork_rng():
        return dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 2, "x": 3})


@pytest.fixture(scope="module")
def panel():
    return dvae.tables.PanelData.of(FRAME, dvae.tables.ColumnHints(id=("unit",), time="step"), dvae.tables.Cut(4, 2))


def fitted(model, data, **options):
    return dvae.fit(model, data, steps=1, **options, **QUIET)


def fitted_by_method(model, data, **options):
    return dvae.fit(METHOD, data, steps=1, **options, **QUIET)


ENTRIES = {
    "fit": fitted,
    "validation": lambda model, data: fitted(model, X, validation=data),
    "a step": lambda model, data: (svi := dvae.SVI(model, steps=1), svi.init(), svi.step(data)),
    "a method's fit": fitted_by_method,
    "a method's model": lambda _, data: METHOD.build(data),
    "evaluate": lambda model, data: dvae.evaluate(model, data, samples=2, **QUIET),
    "compare": lambda model, data: dvae.compare({"a": model}, data, particles=2, contrasts=0, **QUIET),
    "checks": lambda model, data: dvae.predictive_checks(model, data, **QUIET),
    "conformal": lambda model, data: dvae.conformal_bands(model, data, level=0.5, samples=3, **QUIET),
    "forecast": lambda model, data: model.forecast(data, 2),
    "impute": lambda model, data: model.impute(data),
    "bound": dvae.iwae_bound,
}


@pytest.mark.parametrize(
    ("name", "table"),
    [*((name, FRAME) for name in ENTRIES), ("fit", FRAME.set_index(["unit", "step"]).to_xarray())],
)
def test_a_table_without_roles_is_an_error_with_a_suggested_call(model, name, table):
    with pytest.raises(TypeError, match=r"got (pandas|xarray)\..*PanelData\.of\(frame, dvae.tables.ColumnHints\(id="):
        ENTRIES[name](model, table)


@pytest.mark.parametrize("name", ["fit", "validation", "a method's fit", "evaluate", "compare", "checks", "conformal"])
def test_functions_select_their_split_of_the_data(model, panel, name):
    ENTRIES[name](model, panel)


@pytest.mark.parametrize("entry", [fitted, fitted_by_method])
def test_a_fit_uses_the_validation_split_of_its_data(model, panel, entry):
    assert entry(model, panel).best_step == 1
    assert entry(model, panel.windows("train")).best_step is None
    assert entry(model, panel.windows("train"), validation=panel).best_step == 1


@pytest.mark.parametrize("data", [X.numpy(), {"x": X}, dvae.ArrayWindows(X, observed=4)], ids=type)
def test_fitting_a_method_to_arrays_equals_building_it_from_their_sizes(data):
    fit = fitted_by_method(None, data, validation=data)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        recipe = METHOD.train(dvae.data.Sequences({"x": X}), {"x": X}, 1)
        explicit = dvae.fit(METHOD.build({"x": 3}), recipe, decay=0.5, **QUIET)
    assert fit.best_bound == explicit.best_bound


@pytest.mark.parametrize("name", ["evaluate", "checks", "conformal"])
def test_evaluating_on_arrays_without_observed_steps_is_an_error(model, name):
    for data in (X, X.numpy(), {"x": X}):
        with pytest.raises(
            TypeError, match=r"got (Tensor|ndarray|dict); pass an array x \(N, T, D\) as `dvae.ArrayWindows\(x, ob"
        ):
            ENTRIES[name](model, data)


@pytest.mark.parametrize("name", ["fit", "validation", "a step", "a method's fit", "compare", "forecast", "bound"])
def test_sparse_and_meta_tensors_are_an_error(model, name):
    with pytest.raises(TypeError, match=r"layout torch\.sparse_coo; .* x\.to_dense\(\)"):
        ENTRIES[name](model, X.to_sparse())
    with pytest.raises(ValueError, match=r"got a tensor \(20, 6, 3\) on the meta device, which has no values"):
        ENTRIES[name](model, X.to("meta"))
    if name not in ("a method's fit", "compare"):
        with pytest.raises(ValueError, match="on the meta device"):
            ENTRIES[name](dvae.DynamicalVAE("p(z) p(x_t | z)", "q(z | x_{1:T})", {"z": 2, "x": 3}).to("meta"), X)


def test_masks_of_numpy_arrays_are_masks_of_batches():
    x = np.ma.masked_values(np.arange(12.0).reshape(2, 3, 2) - 999 * (np.arange(12) == 5).reshape(2, 3, 2), -994)
    windows, (one, other) = ArrayWindows(x, observed=2), Panel.of(x)
    for batch in (sequences(x).batch, sequences({"x": x}).batch, windows.all()):
        np.testing.assert_array_equal(batch["mask"], ~x.mask)
        np.testing.assert_array_equal(batch["x"], x.filled(0))
    assert windows.fingerprint == ArrayWindows(x.filled(0), observed=2, mask=~x.mask).fingerprint
    np.testing.assert_array_equal([one.values, other.values], x.filled(np.nan))
    assert "mask" not in sequences(np.ma.array(x.filled(0))).batch
    with pytest.raises(TypeError, match=r"got a masked array .*; give"):
        sequences({"x": x.filled(0), "y": x})


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (np.ones((2, 3, 1), complex), "is complex128; expected real numbers: stack the real and the imaginary part"),
        (torch.ones((2, 3, 1), dtype=torch.complex64), "is torch.complex64; expected real numbers"),
        (np.zeros((2, 3, 1), [("a", float), ("b", int)]), r"has the fields a, b; .* pandas.DataFrame\(x\)"),
    ],
    ids=["complex", "tensor", "records"],
)
def test_complex_numbers_and_records_are_an_error(x, message):
    model = dvae.method("autoregressive", width=2).build({"x": 1})
    for call in (sequences, Panel.of, lambda x: ArrayWindows(x, 1), lambda x: model.model({"x": x})):
        with pytest.raises(TypeError, match=message):
            call(x)
