"""Every method satisfies the contract of its factorization, survives its configuration and trains on real motion."""

import copy
import json
import math
import re
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import ClassVar

import pytest
import torch

import dvae
from dvae import motion
from dvae.data.sequences import Sequences
from dvae.models import registry
from dvae.models.family.dkf import Gated, GatedNormal
from dvae.models.method import LatentMethod
from dvae.models.registry import configured
from dvae.motion.data.protocols import Poses
from dvae.testing import FactorizationContract

DOCS = Path(__file__).parents[2] / "docs"
SMALL = {
    "vae": {"hidden": (5, 4)},
    "dkf": {"width": 4, "embed": 3, "embed_latent": (3,), "hidden": (4,), "decoder": (4, 5)},
    "storn": {"width": 4, "embed": 3, "embed_latent": 2, "hidden": (5,)},
    "vrnn": {"width": 4, "embed": (3,), "embed_latent": (2, 3)},
    "srnn": {"width": 4, "embed": 3, "hidden": (4,), "decoder": (5,)},
    "rvae-causal": {"width": 4},
    "rvae-noncausal": {"width": 4},
    "dsae": {"width": 4, "decoder": (4, 5)},
    "kvae": {"width": 4, "hidden": (5, 4)},
    "rslds": {"states": 2, "width": 4, "hidden": (5,), "smoothing": 2},
    "hit-dvae": {"width": 8, "heads_count": 2, "decoder": 8, "pose_width": 2, "frames": 5, "loss": "evidence"},
    "equations": {"width": 4},
}


def small(name, size=2, **options):
    others = {"dsae": ("static",), "hit-dvae": ("static",), "kvae": ("auxiliary",)}.get(name, ())
    return dvae.method(name, **{**dict.fromkeys(("latent", *others), size), **SMALL[name], **options})


class Contract(FactorizationContract):
    name = ""
    waits = 1
    options: ClassVar = {}

    def build(self, size):
        return small(self.name, size, **self.options).build({"x": size})


class TestVAE(Contract):
    name = "vae"
    missing: ClassVar = {}


class TestDKF(Contract):
    name = "dkf"
    missing: ClassVar = {}


class TestGatedTransitionWithCovariates(FactorizationContract):
    missing: ClassVar = {}

    def build(self, size):
        pair = "p(z_t | z_{t-1}, c_t, s) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T}, c_{t:T}, s)"
        networks = {"p(z)": Gated(), "default": dvae.networks.Recurrent(8)}
        return dvae.DynamicalVAE(*pair, {"z": 3, "x": size, "c": 2, "s": 2}, networks, {"p(z)": GatedNormal()})


class TestSRNN(Contract):
    name = "srnn"
    missing: ClassVar = {}


class TestVRNN(Contract):
    name = "vrnn"
    missing: ClassVar = {"z": ("x_{>t}",)}


class TestSTORN(Contract):
    name = "storn"
    missing: ClassVar = {"z": ("x_{>t}", "z_{<t}")}


class TestCausalRVAE(Contract):
    name = "rvae-causal"
    missing: ClassVar = {}


class TestNonCausalRVAE(Contract):
    name = "rvae-noncausal"
    missing: ClassVar = {}


class TestDSAE(Contract):
    name = "dsae"
    missing: ClassVar = {"z": ("z_{<t}",)}


class TestKVAE(Contract):
    name = "kvae"
    missing: ClassVar = {"a": ("x_{>t}", "a_{<t}")}


class TestRSLDS(Contract):
    name = "rslds"
    missing: ClassVar = {"z": ("z_{<=t-2}",)}


class TestSLDS(Contract):
    name = "rslds"
    options: ClassVar = {"recurrent": False}
    missing: ClassVar = {"z": ("z_{<=t-2}",)}


class TestHiTDVAE(Contract):
    name = "hit-dvae"
    missing: ClassVar = {"z": ("z_{<t}",)}


class TestHiTDVAEWithPastInTheGuide(Contract):
    name = "hit-dvae"
    options: ClassVar = {"guide_past": True, "nearest": False}
    missing: ClassVar = {}


class TestPublishedHiTDVAE(Contract):
    name = "hit-dvae"
    options: ClassVar = {"published": True}
    missing: ClassVar = {"z": ("z_{<t}",)}


class TestStandardised(Contract):
    """Standardised variables, inside and outside of loops; distributions keep the unit of the variable."""

    name = "hit-dvae"
    options: ClassVar = {"residual": 0.7}

    def build(self, size):
        model = super().build(size)
        model.units["x"].fit(3 + 2 * torch.randn(20, size))
        model.standardise("z").fit(1 + 0.3 * torch.randn(20, model.sizes["z"]))
        return model


class TestHiTDVAEWithoutAttention(Contract):
    name = "hit-dvae"
    options: ClassVar = {"attention": False, "summary": "attention"}
    missing: ClassVar = {"z": ("z_{<t}",)}


class TestEquationsWithAttention(Contract):
    name = "equations"
    options: ClassVar = {
        "generative": "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-2:t-1}, z_t)",
        "inference": "q(w | x_{1:T}) q(z_t | z_{>t}, x_{1:T}, w)",
        "network": "attention",
        "width": 8,
    }


class TestHiTDVAEWithVampPrior(Contract):
    name = "hit-dvae"
    options: ClassVar = {"prior": "vamp", "prior_components": 3, "prior_steps": 4}


class TestEquationsWithFlow(Contract):
    name = "equations"
    waits = 21  # Pyro's splines select values within their bounds by a mask
    options: ClassVar = {"generative": "p(w) p(x_t | x_{t-1}, w)", "inference": "q(w | x_{1:T})", "prior": "flow"}


class TestContext(FactorizationContract):
    def build(self, size):
        return dvae.DynamicalVAE(
            "p(w | pose) p(z_t | z_{t-1}, c_t, w) p(x_t | x_{t-1}, z_t, c_{1:T}, pose)",
            "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, c_{>=t}, pose, w)",
            {"w": size, "z": size, "x": size, "c": size, "pose": size},
            dvae.networks.Recurrent(4, hidden=(4,)),
        )


def test_every_latent_method_has_a_contract_test():
    family = {name for name, kind in dvae.methods().items() if issubclass(kind, LatentMethod)}
    assert {cls.name for cls in Contract.__subclasses__()} == family == set(SMALL)  # other methods have their own tests


class Peeking(dvae.networks.Dense):
    """A network that reads every parent at t and ignores its relation."""

    def build(self, inputs, local, size):
        now = dvae.factorization.relations.Relation.parse("t")
        return super().build([dvae.networks.Input(p.name, p.size, p.relation and now) for p in inputs], local, size)


class Broken(FactorizationContract):
    def build(self, size):
        pair = ("p(z_t) p(x_t | x_{t-1}, z_t)", "q(z_t | x_{1:T})")
        networks = {"p(x)": Peeking((4,)), "default": dvae.networks.Recurrent(4, hidden=(4,))}
        return dvae.DynamicalVAE(*pair, {"z": size, "x": size}, networks)


def test_reading_undeclared_parents_fails_the_contract():
    with pytest.raises(AssertionError, match="reads"):
        Broken().test_networks_read_the_declared_parents_and_nothing_else()
    with pytest.raises(AssertionError, match="joint differs by"):
        Broken().test_the_log_joint_is_that_of_the_per_step_program()


# -------------------------------------------------------------------------------------- options of every method

OPTIONS = [
    {"emission": "fixed"},
    {"emission": "normal"},
    {"emission": "student"},
    {"emission": "diffusion"},
    {"residual": True},
    {"prior": "mixture", "prior_components": 2},
    {"prior": "vamp", "prior_components": 2, "prior_steps": 4},
    {"prior": "flow"},
    {"prior": "diffusion"},
    {"warm_up": 0},
    {"warm_up": 2, "warm_up_shape": "cosine"},
    {"warm_up": 2, "warm_up_shape": "logistic"},
    {"free_bits": 0.1},
    {"scheduled_sampling": 1.0},
]


def expected_error(name, option):
    """Return the error of an option that the equations of a method do not support, or None."""
    generative = dvae.Factorization.parse(dvae.method(name).generative)
    if "prior" in option and all(factor.local for factor in generative.factors):
        return f"prior='{option['prior']}' needs a static latent without parents"
    if "residual" in option and "x" not in {parent.name for parent in generative.factor("x").parents}:
        return "has a residual distribution, which adds"
    return None


@pytest.mark.parametrize(
    ("name", "option"),
    [(name, option) for m, name in enumerate(SMALL) for n, option in enumerate(OPTIONS) if (m + n) % 4 == 0],
)
def test_a_method_trains_with_an_option_or_raises_the_expected_error(name, option):
    method = small(name, **{"warm_up": 2, "scheduled_sampling": 0.0, **option})
    if expected := expected_error(name, option):
        with pytest.raises(ValueError, match=expected):
            method.build({"x": 3})
        return
    model = method.build({"x": 3})
    before = [parameter.detach().clone() for parameter in model.parameters()]
    recipe = method.train(Sequences({"x": torch.randn(4, 6, 3)}), steps=2)
    result = dvae.fit(model, recipe, batch_size=2, log_every=1, accelerator="cpu", progress=False)
    assert len(result.history) == 2
    assert any(not torch.equal(old, new) for old, new in zip(before, model.parameters(), strict=True))
    assert torch.isfinite(torch.cat([parameter.flatten() for parameter in model.parameters()])).all()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("vae", {"free_bits": -0.1}, "finite"),
        ("vae", {"prior_components": 0}, "least"),
        ("vae", {"warm_up_shape": "step"}, "logistic"),
        (
            "equations",
            {"generative": "p(v) p(w) p(x_t | w, v)", "inference": "q(v | x_{1:T}) q(w | x_{1:T}, v)", "prior": "vamp"},
            "nothing else",
        ),
        ("equations", {"latents": {"z": 2, "u": 3}}, "latents gives sizes of u, but the equations have only z, x"),
    ],
)
def test_invalid_options_are_an_error(name, options, message):
    with pytest.raises(ValueError, match=message):
        dvae.method(name, **options).build({"x": 3})


def test_hidden_entries_are_single_columns_of_arrays_and_whole_steps_of_a_diffusion():
    x, generator = torch.randn(200, 10, 3), torch.Generator().manual_seed(0)
    keep = 0.5**0.5  # of steps, and of entries, independently
    for emission, partial in ((None, keep * (1 - keep**3 - (1 - keep) ** 3)), ("diffusion", 0.0)):
        mask = dvae.method("dkf", hide=0.5, emission=emission).train(x, steps=2).batches.sample(200, generator)["mask"]
        assert mask.double().mean().item() == pytest.approx(0.5, abs=0.04)
        is_partial = mask.any(-1) & ~mask.all(-1)
        assert is_partial.double().mean().item() == pytest.approx(partial, abs=0.04)


@pytest.mark.parametrize("name", ["equations", "rslds"])
def test_recipes_of_arrays_are_prepared_and_stored_like_those_of_windows(name, tmp_path):
    prior = {"prior": "vamp", "prior_components": 3, "prior_steps": 4}
    equations = {"generative": "p(w) p(x_t | w)", "inference": "q(w | x_{1:T})"}
    options = {"rslds": {}, "equations": equations | prior}[name]
    method = small(name, hide=0.2, warm_up=1, **options)
    x = torch.randn(4, 6, 3)
    model = method.build({"x": 3})
    dvae.fit(model, method.train(x, steps=2), out=tmp_path, batch_size=2, accelerator="cpu", progress=False)
    assert torch.isfinite(torch.cat([parameter.flatten() for parameter in model.parameters()])).all()


@pytest.mark.parametrize("name", ["erd", "aclstm", "moglow"])
def test_units_of_arrays_are_fitted(name):
    model, x = dvae.method(name, width=4).build({"x": 3}), 5 + torch.randn(8, 6, 3)
    dvae.fit(model, dvae.method(name, width=4).train(x, steps=2), batch_size=2, accelerator="cpu", progress=False)
    assert (model.units["x"].mean - 5).abs().max() < 1


def test_scheduled_sampling_does_not_apply_to_models_that_read_no_data():
    """The discrete states of a switching model are no data."""
    feeding = {
        name: dvae.method(name, scheduled_sampling=1.0).train(torch.zeros(2, 3, 1), steps=10).feeding
        for name in ("dkf", "rslds", "srnn")
    }
    assert feeding["dkf"] == feeding["rslds"] == 0.0
    assert feeding["srnn"] != 0.0


# ----------------------------------------------------------------------------- the family's published networks

PUBLISHED = {  # parameters of the public implementation at its sizes for motion: x 96, z 10
    "vae": 7_284,
    "dkf": 52_856,
    "storn": 96_500,
    "vrnn": 61_592,
    "srnn": 100_232,
    "rvae-causal": 89_204,
    "rvae-noncausal": 157_556,
    "dsae": 217_084,
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_default_networks_have_the_published_size(name):
    statics = {"static": 10} if name == "dsae" else {}
    model = dvae.method(name, latent=10, **statics).build({"x": 96})
    scales = model.generator[
        "x"
    ].head.log_scale.numel()  # one for each coordinate: the public code has no likelihood of x
    assert sum(parameter.numel() for parameter in model.parameters()) - scales == PUBLISHED[name]


@pytest.mark.parametrize("batch_and_steps", [(3, 6), (1, 1)])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("name", ["dkf", "vrnn", "srnn", "rvae-causal", "rvae-noncausal"])
def test_the_fused_loop_of_a_guide_equals_its_plain_loop(name, activation, batch_and_steps):
    model = small(name, 3).build({"x": 5}).double()
    for module in model.modules():
        for key, child in module.named_children():
            if activation == "relu" and isinstance(child, torch.nn.Tanh):
                setattr(module, key, torch.nn.ReLU())
        if hasattr(module, "kind"):
            module.kind = activation
    plain, calls = copy.deepcopy(model), []
    plain.encoder["z"].chain = lambda *_: None
    chain = model.encoder["z"].chain
    model.encoder["z"].chain = lambda *args: calls.append(chain(*args)) or calls[-1]
    x = torch.randn(*batch_and_steps, 5, dtype=torch.float64)
    results = []
    for variant in (model, plain):
        torch.manual_seed(1)
        bound = dvae.SequenceELBO().terms(variant, x).bound
        results.append((bound, torch.autograd.grad(bound.sum(), list(variant.parameters()), materialize_grads=True)))
    assert calls[0] is not None
    torch.testing.assert_close(results[0], results[1], rtol=0, atol=1e-10)


def later(values):
    """Return the values shifted one step later, with 0 at the first."""
    return torch.cat([torch.zeros_like(values[:, :1]), values[:, :-1]], dim=1)


def backward(lstm, values):
    return lstm(values.flip(1))[0].flip(1)


def test_networks_are_connected_as_in_the_papers():
    """Features of factors with shared or stacked states are recomputed from the same layers."""
    x, z = (torch.randn(2, 6, size, dtype=torch.float64) for size in (5, 3))
    parents = {"x": x, "z": z}

    def networks(name):
        model = small(name, 3).build({"x": 5}).double()
        return (f["z"].network if "z" in f else None for f in (model.generator, model.encoder)), model

    (prior, guide), model = networks("srnn")
    h = prior.past.layers[0](prior.past.embed(later(x)))[0]
    future = guide.memories[0]
    g = backward(future.layers[0], future.embed(torch.cat([h, x], -1)))
    torch.testing.assert_close(guide(parents, 6), guide.join([g, later(z)]))
    torch.testing.assert_close(prior(parents, 6), prior.join([h, later(z)]))
    torch.testing.assert_close(model.generator["x"].network(parents, 6), model.generator["x"].network.join([h, z]))

    (_, guide), _ = networks("dkf")
    state = backward(guide.memories[0].layers[0], guide.memories[0].embed(x))
    g = (state + later(guide.extractors["z"](z))) / 2
    torch.testing.assert_close(guide(parents, 6), torch.tanh(guide.join.first(g)))

    (prior, guide), model = networks("vrnn")
    fx, fz = prior.extractors["x"](x), prior.extractors["z"](z)
    h = prior.past.layers[0](torch.cat([later(fx), later(fz)], -1))[0]
    torch.testing.assert_close(prior(parents, 6), h)
    torch.testing.assert_close(guide(parents, 6), torch.cat([h, fx], -1))
    torch.testing.assert_close(model.generator["x"].network(parents, 6), torch.cat([h, fz], -1))

    (_, guide), model = networks("storn")
    torch.testing.assert_close(guide(parents, 6), guide.join([guide.past.layers[0](guide.extractors["x"](x))[0]]))
    decoder = model.generator["x"].network
    inputs = torch.cat([later(decoder.extractors["x"](x)), decoder.extractors["z"](z)], -1)
    torch.testing.assert_close(decoder(parents, 6), decoder.past.layers[0](inputs)[0])

    for name in ("rvae-causal", "rvae-noncausal"):
        (_, guide), model = networks(name)
        states = {(m.direction, m.reads[0]): m.layers[0] for m in guide.memories}
        expected = [states[1, ("z", -1)](later(z))[0], backward(states[-1, ("x", 0)], x)]
        if name == "rvae-noncausal":
            expected.insert(1 if guide.memories[1].reads[0][0] == "x" else 0, states[1, ("x", -1)](later(x))[0])
        torch.testing.assert_close(guide(parents, 6), torch.cat(expected, -1))

    _, model = networks("dsae")
    static = model.encoder["w"].network
    past, future = (memory.layers[0] for memory in static.memories)
    expected = torch.cat([past(x)[0][:, -1], backward(future, x)[:, 0]], -1)
    torch.testing.assert_close(static({"x": x}, 6), expected)


def test_the_example_method_of_the_docs_works_and_has_a_new_name():
    page = (DOCS / "how-to" / "new_method.md").read_text(encoding="utf-8")
    definition = page.split("```python\n")[1].partition("\npeople = ")[0]
    space = {}
    exec(compile(definition, "new_method.md", "exec", dont_inherit=True), space)
    kind = space["SecondOrder"]
    assert kind.name not in dvae.methods()
    assert f"{kind.name} = " in page
    assert torch.isfinite(dvae.SequenceELBO().terms(kind(latent=2).build({"x": 3}), torch.randn(2, 4, 3)).bound).all()


# ------------------------------------------------------------------------------------------------- the registry


@pytest.mark.parametrize("name", SMALL)
def test_a_method_survives_its_configuration(name):
    for method in (dvae.method(name), small(name)):
        copy_of_method = configured(json.loads(json.dumps(method.config())))
        assert copy_of_method == method
        torch.manual_seed(0)
        first = method.build({"x": 4}).state_dict()
        torch.manual_seed(0)
        second = copy_of_method.build({"x": 4}).state_dict()
        assert all(torch.equal(value, second[key]) for key, value in first.items())


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda: dvae.method("hit_dvae"), "unknown method"),
        (lambda: dvae.method("srnn", latents=3), "option"),
        (lambda: dvae.method("vae", emission="gamma").build({"x": 1}), "emission"),
        (lambda: configured({"latent": 3}), "configuration has no key 'method'"),
    ],
)
def test_unknown_methods_and_options_are_an_error(run, message):
    with pytest.raises(ValueError, match=message):
        run()


NEEDS = (
    r"missing 1 required positional argument|sizes missing for|needs the description of poses|batch must contain|"
    r"this model reads"
)


@pytest.mark.parametrize("name", dvae.methods())
def test_a_method_built_from_sizes_works_or_names_what_is_missing(name):
    for data in ([], [{}], [{"x": 7}]):
        message = None
        try:
            model = dvae.method(name).build(*data)
            x = torch.randn(2, 4, model.sizes["x"])
            loss, future = dvae.SequenceELBO().loss(model, model.guide, x), model.forecast(x, 2)["x"]
        except (TypeError, ValueError) as error:
            message = str(error)
        assert math.isfinite(loss) and torch.isfinite(future).all() if message is None else re.search(NEEDS, message)


def test_entry_points_add_methods_but_cannot_replace_one(monkeypatch):
    def points(value, name):
        return lambda group: [EntryPoint(name, value, group)] if group == "dvae.methods" else []

    dvae.methods.cache_clear()
    try:
        monkeypatch.setattr(registry, "entry_points", points("dvae.models.family.dkf:DKF", "other"))
        assert dvae.methods()["other"].name == "dkf"
        dvae.methods.cache_clear()
        monkeypatch.setattr(registry, "entry_points", points("elsewhere:DKF", "dkf"))
        with pytest.raises(ValueError, match="elsewhere"):
            dvae.methods()
    finally:
        dvae.methods.cache_clear()


@pytest.mark.parametrize("name", ["gsps", "bom-parts", "hit-dvae", "cvae", "aclstm"])
def test_poses_without_known_sides_have_no_heading(name):
    skeleton = motion.Skeleton(("root", "a", "b", "c", "d"), (-1, 0, 1, 0, 3), name="unnamed")
    poses = Poses.from_data(motion.PROTOCOLS["simulated"], skeleton)
    assert dvae.method(name).resolve_defaults(poses).heading is False


@pytest.mark.parametrize("name", ["trajevae", "cvae-rnn", "moglow", "mt-vae", "cvae", "dlow"])
def test_published_trainings_without_clipping_have_none(name):
    """Sources: the public code of TrajeVAE, MT-VAE and DLow."""
    poses = Poses.from_data(motion.PROTOCOLS["h36m"], motion.HUMAN36M)
    assert dvae.method(name).training(poses).gradient_clip is None


# ------------------------------------------------------------------------------------------ diffusion of all steps


def test_equations_of_all_steps_have_one_diffusion_and_forecast_only_with_context():
    options = {"inference": "", "emission": "diffusion", "width": 16}
    method = dvae.method("equations", generative="p( x_{1 :T} )", **options)
    assert method.build({"x": 2}).generator["x"].joint
    assert not dvae.method("equations", generative="p(x_t | x_{<t})", **options).build({"x": 2}).generator["x"].joint
    with pytest.raises(ValueError, match=r"residual is 1\.0, but a diffusion of all steps has no previous"):
        dvae.method("equations", generative="p(x_{1:T})", residual=1.0, **options).build({"x": 2})
    windows = dvae.ArrayWindows(torch.randn(8, 6, 2), observed=4)
    with pytest.raises(ValueError, match=r"draws all steps of x jointly.*--select bound"):
        dvae.fit(method, windows, windows, steps=2, select="forecast", progress=False)
    fit = dvae.fit(method, windows, windows, steps=2, select="bound", progress=False)
    assert "residual" not in fit.best
    assert dvae.compare({"whole": fit.model}, windows, samples=0, progress=False)["whole"]["ELBO"].mean < 0


# ---------------------------------------------------------------------------------------------------- real motion


@pytest.fixture(scope="module")
def people(real):
    return motion.windows(real("bandai/bandai2.npz"), motion.PROTOCOLS["bandai2-by-style"], "train", length=10)


@pytest.mark.data
@pytest.mark.parametrize("name", ["srnn", "dsae", "kvae"])  # recurrent, with a static latent, a filter
def test_training_on_real_motion_stays_finite(name, people):
    method = small(name, 4, warm_up=20)
    model = method.build({"x": people.size})
    recipe = method.train(people, steps=30)
    result = dvae.fit(model, recipe, batch_size=4, accelerator="cpu", progress=False)
    assert result.history
    assert all(torch.isfinite(parameter).all() for parameter in model.parameters())
    x = people.sample(2, torch.Generator().manual_seed(0))["x"]
    assert torch.isfinite(model.forecast(x, 20, 2)["x"]).all()
