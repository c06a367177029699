"""Every method keeps the contract of its factorizations; the registry finds it; it trains on real motion."""

import json
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import ClassVar

import pytest
import torch

import dvae
from dvae import motion
from dvae.models import from_config
from dvae.testing import FactorizationContract

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SMALL = {
    "vae": {"hidden": (5, 4)},
    "dkf": {"width": 4, "hidden": (4,), "decoder": (4, 5)},
    "srnn": {"width": 4, "embed": 3, "hidden": (4,), "decoder": (5,)},
    "vrnn": {"width": 4, "embed": 3, "hidden": (4,)},
    "hit-dvae": {"width": 8, "heads_count": 2, "decoder": 8},
    "equations": {"width": 4},
}


def small(name, size=2, **options):
    statics = {"static": size} if name == "hit-dvae" else {}
    return dvae.method(name, latent=size, **statics, **{**SMALL[name], **options})


class Contract(FactorizationContract):
    name = ""
    options: ClassVar = {}

    def build(self, size):
        return small(self.name, size, **self.options).build({"x": size})


class TestVAE(Contract):
    name = "vae"


class TestDKF(Contract):
    name = "dkf"


class TestSRNN(Contract):
    name = "srnn"


class TestVRNN(Contract):
    name = "vrnn"


class TestHiTDVAE(Contract):
    name = "hit-dvae"


class TestEquations(Contract):
    name = "equations"


class TestEquationsWithAttention(Contract):
    name = "equations"
    options: ClassVar = {
        "generative": "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-2:t-1}, z_t)",
        "inference": "q(w | x_{1:T}) q(z_t | z_{>t}, x_{1:T}, w)",
        "network": "attention",
        "width": 8,
    }


class TestContext(FactorizationContract):
    def build(self, size):
        return dvae.DynamicalVAE(
            "p(w | pose) p(z_t | z_{t-1}, c_t, w) p(x_t | x_{t-1}, z_t, c_{1:T}, pose)",
            "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, c_{>=t}, pose, w)",
            {"w": size, "z": size, "x": size, "c": size, "pose": size},
            dvae.networks.Recurrent(4, hidden=(4,)),
        )


def test_every_method_is_held_to_the_contract():
    assert {cls.name for cls in Contract.__subclasses__()} == set(dvae.methods()) == set(SMALL)


class Peeking(dvae.networks.Dense):
    """Reads every parent at t, whatever its relation."""

    def build(self, inputs, local, size):
        now = dvae.notation.Relation.parse("t")
        return super().build([dvae.networks.Input(p.name, p.size, p.relation and now) for p in inputs], local, size)


class Broken(FactorizationContract):
    def build(self, size):
        pair = ("p(z_t) p(x_t | x_{t-1}, z_t)", "q(z_t | x_{1:T})")
        networks = {"p(x)": Peeking((4,)), "default": dvae.networks.Recurrent(4, hidden=(4,))}
        return dvae.DynamicalVAE(*pair, {"z": size, "x": size}, networks)


def test_a_network_that_reads_what_it_should_not_breaks_the_contract():
    with pytest.raises(AssertionError, match="reads x where its mask hides it"):
        Broken().test_networks_read_the_declared_parents_and_nothing_else()
    with pytest.raises(AssertionError, match="joint differs by"):
        Broken().test_the_log_joint_is_that_of_the_per_step_program()


# ------------------------------------------------------------------------------------------------- the registry


@pytest.mark.parametrize("name", SMALL)
def test_a_method_survives_its_configuration(name):
    for method in (dvae.method(name), small(name)):
        again = from_config(json.loads(json.dumps(method.config())))
        assert again == method
        torch.manual_seed(0)
        first = method.build({"x": 4}).state_dict()
        torch.manual_seed(0)
        second = again.build({"x": 4}).state_dict()
        assert all(torch.equal(value, second[key]) for key, value in first.items())


@pytest.mark.parametrize("name", [name for name in SMALL if name != "equations"])
def test_a_method_says_what_it_is(name):
    method = dvae.methods()[name]
    assert "arXiv" in method.source
    model = small(name).build({"x": 3})
    assert model.generative.text == dvae.Factorization.parse(method.generative).text
    assert model.inference.text == dvae.Factorization.parse(method.inference).text


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda: dvae.method("hit_dvae"), r"unknown method 'hit_dvae' \(did you mean 'hit-dvae'\?\); known: vae, dkf"),
        (lambda: dvae.method("lstm"), "unknown method 'lstm'"),
        (lambda: dvae.method("srnn", latents=3), r"srnn has no option 'latents' \(did you mean 'latent'\?\); it has"),
        (
            lambda: dvae.method("vae", emission="gamma").build({"x": 1}),
            "unknown emission 'gamma'; known: normal, fixed",
        ),
        (lambda: dvae.method("equations", network="gru").build({"x": 1}), "unknown network 'gru'; known: recurrent"),
        (lambda: from_config({"latent": 3}), "the configuration names no method: it holds latent"),
        (lambda: from_config({}), "the configuration names no method: it holds nothing"),
    ],
)
def test_methods_that_are_not(run, message):
    with pytest.raises(ValueError, match=message):
        run()


def test_entry_points_add_methods_and_cannot_replace_any(monkeypatch):
    def points(value, name):
        return lambda group: [EntryPoint(name, value, group)] if group == "dvae.methods" else []

    module = sys.modules["dvae.models.method"]  # dvae.models.method is the function of that name
    dvae.methods.cache_clear()
    try:
        monkeypatch.setattr(module, "entry_points", points("dvae.models.dkf:DKF", "other"))
        assert dvae.methods()["other"].name == "dkf"
        dvae.methods.cache_clear()
        monkeypatch.setattr(module, "entry_points", points("elsewhere:DKF", "dkf"))
        with pytest.raises(ValueError, match="entry point elsewhere:DKF has the name of a method that exists: dkf"):
            dvae.methods()
    finally:
        dvae.methods.cache_clear()


# ---------------------------------------------------------------------------------------------------- real motion


@pytest.fixture(scope="module")
def people():
    file = DATA / "bandai" / "bandai2.npz"
    if not file.exists():
        pytest.skip("the real motion capture is not beside the project")
    return motion.windows(motion.load(file), motion.PROTOCOLS["bandai2-by-style"], "train", length=10)


@pytest.mark.data
@pytest.mark.parametrize("name", SMALL)
def test_training_on_real_motion_stays_finite(name, people):
    method = small(name, 4, warm_up=20)
    model = method.build({"x": people.size})
    result = dvae.fit(
        model,
        people,
        objective=method.objective(),
        self_feeding=method.feeding(100),
        steps=100,
        batch_size=4,
        accelerator="cpu",
        progress=False,
    )
    assert result.history
    assert all(torch.isfinite(parameter).all() for parameter in model.parameters())
    x = people.sample(2, torch.Generator().manual_seed(0))["x"]
    assert torch.isfinite(model.forecast(x, 20, 2)["x"]).all()
