"""Units: networks see standardised variables; values and densities keep their own units."""

import math

import pytest
import torch
from pyro import poutine

import dvae
from dvae.data.units import Coordinate, Units
from dvae.networks import Attention, Recurrent

PAIR = ("p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)")
SIZES = {"w": 2, "z": 2, "x": 3}


def seeded(function):
    torch.manual_seed(2)
    return function()


def test_fitted_units_leave_mean_zero_and_mean_variance_one():
    units, values = Units(3).double(), torch.tensor([1.0, -2.0, 5.0]) + torch.randn(7, 40, 3, dtype=torch.float64)
    units.fit(values)
    rows = units(values).flatten(0, 1)
    torch.testing.assert_close(rows.mean(0), torch.zeros(3, dtype=torch.float64))
    assert rows.var(0).mean().item() == pytest.approx(1)
    before, after = (v[0, :20] - v[0, 20:] for v in (values, units(values)))
    torch.testing.assert_close(torch.cosine_similarity(before, after), torch.ones(20, dtype=torch.float64))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (torch.arange(8.0).reshape(4, 2), r"units need values \(\.\.\., 3\) that vary"),
        (torch.ones(4, 3), r"units need values \(\.\.\., 3\) that vary"),
        (
            1e-40 * torch.arange(12.0).double().reshape(4, 3),
            r"standard deviation of these values is .*e-\d+; .* multiply",
        ),
    ],
    ids=["another size", "a constant", "too small"],
)
def test_units_come_from_values_that_vary(values, message):
    with pytest.raises(ValueError, match=message):
        Units(3).fit(values)
    with pytest.raises(ValueError, match="given units, which cannot be fitted"):
        Units(3, [Coordinate(1.0, 2.0)] * 3).fit(values)
    with pytest.raises(ValueError, match="no variable 'y'; there are w, z, x"):
        dvae.DynamicalVAE(*PAIR, SIZES).standardise("y")


@pytest.mark.parametrize(
    ("network", "distribution"),
    [
        (Attention(8, heads=2), dvae.distributions.Normal(residual=0.5)),
        (Recurrent(4), dvae.distributions.FixedNormal(0.3, learned=True)),
        (Recurrent(4), dvae.distributions.StudentT()),
    ],
)
def test_a_standardised_model_equals_a_model_of_standardised_data(network, distribution):
    """log p(x) = log p(u) - T D log s for u = (x - m) / s, and the guide draws the same latents."""
    torch.manual_seed(0)
    plain = dvae.DynamicalVAE(*PAIR, SIZES, network, {"p(x)": distribution}).double()
    torch.manual_seed(0)
    model = dvae.DynamicalVAE(*PAIR, SIZES, network, {"p(x)": distribution}).double()
    units = model.standardise("x").double()
    x = 4 + 0.1 * torch.randn(5, 6, 3, dtype=torch.float64)
    units.fit(x)
    latents, same_latents = seeded(lambda: model.guide(x)), seeded(lambda: plain.guide(units(x)))
    for name in latents:
        torch.testing.assert_close(latents[name], same_latents[name])
    log_joint, same_log_joint = model.log_joint(x, latents), plain.log_joint(units(x), same_latents)
    torch.testing.assert_close(log_joint["z"], same_log_joint["z"])
    log_det = -x[0].numel() * units.scale.log()
    torch.testing.assert_close(log_joint["x"], same_log_joint["x"] + log_det)
    mask = torch.rand_like(x) < 0.7
    results = []
    for each, data in ((model, x), (plain, units(x))):
        z = seeded(lambda e=each, d=data: e.guide({"x": d, "mask": mask})["z"])
        bound = seeded(lambda e=each, d=data: dvae.fivo_bound(e, d, particles=3).bound)
        results.append((z, bound, seeded(lambda e=each, d=data: e.forecast(d[:, :3], 4, 2)["x"])))
    (z, bound, future), (same_z, same_bound, same_future) = results
    torch.testing.assert_close(z, same_z)
    torch.testing.assert_close(bound, same_bound + log_det)
    torch.testing.assert_close(units(future), same_future)


def test_a_given_scale_is_in_the_unit_of_the_variable():
    model = dvae.DynamicalVAE(*PAIR, SIZES, distributions={"p(x)": dvae.distributions.FixedNormal(0.3)})
    x = 4 + 0.1 * torch.randn(5, 6, 3)
    model.standardise("x").fit(x)
    site = poutine.trace(model.model).get_trace(x).nodes["x"]
    assert torch.allclose(site["fn"].steps(x).scale, torch.tensor(0.3))


def test_units_of_a_batch_leave_out_missing_entries_and_padding():
    x, lengths, mask = 4 + torch.randn(5, 6, 3), torch.tensor([2, 3, 4, 5, 6]), torch.rand(5, 6, 3) < 0.8
    known = mask & (torch.arange(6) < lengths[:, None])[..., None]
    batch = {"x": torch.where(known, x, 1e3), "lengths": lengths, "mask": {"x": mask}}
    units = dvae.DynamicalVAE(*PAIR, SIZES).standardise("x")
    units.fit(batch)
    expected = dvae.DynamicalVAE(*PAIR, SIZES).standardise("x")
    expected.fit(torch.where(known, x, math.nan))
    torch.testing.assert_close((units.mean, units.scale), (expected.mean, expected.scale))
    assert (units.mean - 4).abs().max() < 2
    with pytest.raises(ValueError, match=r"the mask of x is torch.bool \(5, 6\); expected bool \(5, 6, 3\)"):
        units.fit({"x": x, "mask": mask[..., 0]})
    with pytest.raises(ValueError, match="the batch has no 'x'; it has y"):
        units.fit({"y": x})
    with pytest.raises(TypeError, match=r"got ArrayWindows; a batch of all windows is windows.all\(\)"):
        units.fit(dvae.ArrayWindows(x, 3))


def test_a_mask_that_is_not_boolean_is_an_error():
    model = dvae.DynamicalVAE(*PAIR, SIZES)
    with pytest.raises(ValueError, match=r"the mask of x is torch.float32 \(5, 6, 3\); expected bool"):
        dvae.fit(model, {"x": torch.randn(5, 6, 3), "mask": torch.ones(5, 6, 3)}, steps=1, progress=False)


def far(mean, scale, distribution=None, network=None, **options):
    """Return a standardised float32 model of data (B, T, D) with a mean and scale, and the same without the mean."""
    torch.manual_seed(0)
    shift = torch.tensor([mean, -mean, 0.0], dtype=torch.float64)
    x = shift + scale * torch.randn(6, 8, 3, dtype=torch.float64)
    results = []
    for data in (x, x - shift):
        torch.manual_seed(1)
        model = dvae.DynamicalVAE(
            *PAIR, SIZES, network or Recurrent(4), {"p(x)": distribution or dvae.distributions.Normal()}, **options
        )
        model.standardise("x").fit(data)
        results += [model, data]
    return shift, *results


NORMAL, LAPLACE = dvae.distributions.Normal(), dvae.distributions.Family("Laplace")


@pytest.mark.parametrize(
    ("mean", "scale", "distribution"),
    [
        (1e6, 1.0, dvae.distributions.Normal(residual=0.5)),
        (1e9, 1.0, dvae.distributions.StudentT()),
        (101325.0, 0.01, dvae.distributions.NormalMixture(2)),
        (1e9, 1.0, dvae.distributions.LowRankNormal()),
        (1e9, 1.0, dvae.distributions.Product((((2, 0), NORMAL), ((1,), LAPLACE)))),
    ],
    ids=str,
)
def test_a_large_mean_changes_neither_bound_nor_forecast(mean, scale, distribution):
    shift, model, x, plain, y = far(mean, scale, distribution)
    masks = torch.rand(6, 8, 1).expand(6, 8, 3) < 0.8
    for extra in ({}, {"mask": masks}, {"lengths": torch.tensor([8, 3, 5, 8, 1, 2])}):
        terms, plain_terms = (
            seeded(lambda b=b, m=m: dvae.SequenceELBO().terms(m, b))
            for m, b in ((model, {"x": x, **extra}), (plain, {"x": y, **extra}))
        )
        assert terms.bound.dtype == torch.float32
        torch.testing.assert_close(terms.bound, plain_terms.bound, rtol=1e-5, atol=1e-3)
        terms.bound.sum().backward()
    future, plain_future = (
        seeded(lambda m=m, b=b: m.forecast(b, 3, 4, draw_emission=True)["x"]) for m, b in ((model, x), (plain, y))
    )
    assert future.dtype == torch.float64
    torch.testing.assert_close((future - shift) / scale, plain_future / scale, rtol=0, atol=1e-3)
    imputed = model.impute({"x": x, "mask": masks}, draw=True)["x"][0]
    assert torch.equal(imputed[masks], x[masks])


@pytest.mark.parametrize("mean", [0.0, 1e9])
def test_context_and_sites_keep_their_own_unit(mean):
    torch.manual_seed(0)
    sizes = {"z": 2, "x": 1, "c": 1}
    model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t, c_t)", "q(z_t | x_{1:T}, c_t)", sizes)
    x, c = (mean + torch.randn(2, 4, 7, 1, dtype=torch.float64)).unbind()
    for name, values in (("x", x), ("c", c)):
        model.standardise(name).fit(values)
    trace = poutine.trace(model.model).get_trace({"x": x, "c": c})
    assert torch.equal(trace.nodes["x"]["value"], x)
    torch.testing.assert_close(trace.nodes["x"]["fn"].steps(x).mean / 1e9, x / 1e9, rtol=0, atol=1e-8)
    batch = model.read({"x": x, "c": c})
    assert torch.equal(model.read(batch)["c"], c)
    bounds = [dvae.fivo_bound(model, {"x": x, "c": c}, particles=3).bound for _ in range(2)]
    assert all(bound.isfinite().all() and (bound > -100).all() for bound in bounds)


def test_a_large_mean_changes_neither_scheduled_sampling_nor_vamp_priors():
    vamp = {"distributions": {"p(w)": dvae.distributions.Vamp(3, steps=2), "p(x)": dvae.distributions.Normal()}}
    pair = ("p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-1}, z_t)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)")
    bounds = []
    for mean in (0.0, 1e9):
        torch.manual_seed(0)
        x = torch.randn(4, 6, 3, dtype=torch.float64)
        model = dvae.DynamicalVAE(*pair, SIZES, Recurrent(4), **vamp)
        model.standardise("x").fit(mean + x)
        model.generator["w"].head.start_at(model.read(mean + x[:3]))
        schedule = dvae.ScheduledSampling(0.5)
        bounds.append(
            seeded(lambda m=model, d=mean + x: dvae.SequenceELBO().terms(m, d, scheduled_sampling=schedule).bound)
        )
    torch.testing.assert_close(*bounds, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("entry", ["", "mask", "lengths"])
def test_values_that_float32_does_not_resolve_need_units(entry):
    x, mask, lengths = 1e9 + torch.randn(4, 6, 3).double(), torch.rand(4, 6, 3) < 0.9, torch.tensor([6, 5, 6, 2])
    is_step = (torch.arange(6) < lengths[:, None])[..., None]
    data = {"": {"x": x}, "mask": {"x": x * mask, "mask": mask}, "lengths": {"x": x * is_step, "lengths": lengths}}[
        entry
    ]
    model = dvae.DynamicalVAE(*PAIR, SIZES)
    with pytest.raises(ValueError, match=r"coordinate 0 of x has mean 1e\+09 and .* model.standardise\('x'\).fit"):
        model.guide(data)
    model.double().guide(data)
    dvae.DynamicalVAE(*PAIR, SIZES).guide({"x": torch.full((2, 3, 3), 1 / 3, dtype=torch.float64)})  # no spread to lose


def test_means_stay_float64_in_other_precisions_and_files():
    _, model, x, *_ = far(1e9, 1.0)
    mean = model.units["x"].mean.clone()
    for converted in (model.double(), model.bfloat16(), model.float()):
        assert torch.equal(converted.units["x"].mean, mean)
    fresh = dvae.DynamicalVAE(*PAIR, SIZES, Recurrent(4))
    fresh.standardise("x")
    fresh.load_state_dict(model.state_dict())
    assert torch.equal(fresh.units["x"].mean, mean)
    older = {name: value.float() for name, value in model.state_dict().items()}
    fresh.load_state_dict(older)  # a file with means in float32 keeps them
    assert fresh.units["x"].mean.dtype == torch.float32
    single = dvae.DynamicalVAE(*PAIR, SIZES).standardise("x")
    single.fit(x.float())  # float32 values, such as motion, are not converted
    assert not single.wide


@pytest.mark.parametrize(("scale", "dtype"), [(1e-20, torch.float64), (1e-40, torch.float32), (1e-46, torch.float32)])
def test_fitting_values_too_small_for_float32_without_units_is_an_error(scale, dtype):
    x = (scale * torch.randn(4, 6, 3, dtype=torch.float64)).to(dtype)
    model = dvae.DynamicalVAE(*PAIR, SIZES)
    if not x.any():
        dvae.fit(model, x, steps=1, progress=False)  # a constant has no scale
        return
    padded = torch.cat([x, torch.ones_like(x)], 1)
    for data in (x, {"x": x + 0, "mask": torch.rand(x.shape) < 0.9}, {"x": padded, "lengths": torch.full((4,), 6)}):
        with pytest.raises(ValueError, match=r"standard deviation of x is .*e-\d+; .* multiply the values"):
            dvae.fit(model, data, steps=1, progress=False)
    dvae.fit(model, torch.full((4, 6, 3), 0.05, dtype=dtype), steps=1, progress=False)
    dvae.fit(model.double(), x, steps=1, progress=False)


def test_sequences_that_lose_precision_in_float32_are_named():
    x = torch.randn(6, 5, 3, dtype=torch.float64)
    x[..., 1] += torch.linspace(0, 1e9, 6)[:, None]
    x[2, ..., 1] = 1e8  # a constant loses nothing
    units = dvae.DynamicalVAE(*PAIR, SIZES).standardise("x")
    for values in (x, x.numpy()):
        with pytest.warns(UserWarning, match=r"in 5 of 6 sequences, such as 0, coordinate 1 .* own mean, or fit in"):
            units.fit(values)
    dvae.DynamicalVAE(*PAIR, SIZES).double().standardise("x").fit(x)
    units.fit(1e9 + x - x.mean(1, keepdim=True))


def test_a_large_mean_does_not_change_training():
    torch.manual_seed(0)
    x, losses = torch.randn(6, 5, 3, dtype=torch.float64), []
    for mean in (0.0, 1e9):
        torch.manual_seed(0)
        model = dvae.DynamicalVAE(*PAIR, SIZES, Attention(8, heads=2))
        model.standardise("x").fit(mean + x)
        torch.manual_seed(0)
        dvae.fit(model, mean + x, steps=2, progress=False, precision="bf16-mixed")
        losses.append(seeded(lambda m=model, d=mean + x: dvae.SequenceELBO().terms(m, d).bound))
    torch.testing.assert_close(*losses, rtol=1e-4, atol=1e-2)
