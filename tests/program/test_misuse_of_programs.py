"""Invalid networks, distributions and programs are an error."""

import math

import pytest
import torch
from pyro import poutine

import dvae
from dvae import Discrete, DynamicalVAE, InputNoise, Oracle, ScheduledSampling, linear_gaussian_surrogate, model_kl_gap
from dvae.data import views
from dvae.data.units import Coordinate
from dvae.distributions import (
    ConditionalFlow,
    Family,
    FixedNormal,
    Mixture,
    Normal,
    NormalMixture,
    QRFlow,
    Shape,
    StudentT,
    Vamp,
)
from dvae.factorization.relations import Relation
from dvae.networks import (
    Attention,
    CosineDecoder,
    CosineEncoder,
    Dense,
    FrameGraph,
    GraphConv,
    Input,
    Linear,
    LinearSDE,
    LinearSDEGuide,
    Recurrent,
    SelfAttention,
    WholeDecoder,
    WithNoise,
)
from dvae.networks.recurrent import tie
from dvae.networks.sde import Equation

T = 5
DKF = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})")
GAPS = ("p(z_t | z_{t-1}, d_t) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T}, d_{1:T})")
NOISY = ("p(z_t) p(x_t | z_t, s_t)", "q(z_t | x_t)")
GROUPED = ("p(g) p(w | g) p(x_t | w, g)", "q(g | x_{1:T}) q(w | x_{1:T}, g)")
STATES = ("p(k_t | k_{t-1}) p(x_t | k_t, x_{t-1})", "")
MODEL = DynamicalVAE(*DKF, {"z": 2, "x": 3}).double()
LINEAR = linear_gaussian_surrogate(*DKF, {"z": 1, "x": 1}, T)
SUMMED = DynamicalVAE(*STATES, {"k": Discrete(3), "x": 2}).double()
TWO = DynamicalVAE("p(z_t) p(x_t | z_t) p(y_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 3, "y": 1}, observed=("x", "y"))
X, Y = torch.zeros(3, T, 3, dtype=torch.float64), torch.zeros(3, T, 2, dtype=torch.float64)
ALL, BEFORE, NOW = (Relation.parse(text) for text in ("1:T", "<t", "t"))


def built(spec, *inputs, local=True, size=2):
    return spec.build([Input(name, width, relation) for name, width, relation in inputs], local, size)


def model(equations=DKF, sizes=(("z", 2), ("x", 3)), **options):
    return DynamicalVAE(*equations, dict(sizes), **options)


def prior(distribution, inference="q(w | x_{1:T}) q(z_t | x_{1:T}, w)", key="p(w)"):
    return model(
        ("p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)", inference),
        {"w": 2, "z": 2, "x": 2},
        distributions={key: distribution},
    )


def floored():
    linear = linear_gaussian_surrogate(*DKF, {"z": 1, "x": 1}, T)
    linear.standardise("z", [Coordinate(floor=0.1)])
    return Oracle(linear, T).gap()


NETWORKS = [
    (lambda: built(Attention(10, heads=4), ("z", 2, BEFORE)), "multiple"),
    (lambda: built(SelfAttention(), ("z", 2, BEFORE)), "local child"),
    (lambda: built(FrameGraph(3), ("z", 2, ALL)), "parents"),
    (lambda: built(Recurrent(cell="rnn"), ("z", 2, BEFORE)), "cell"),
    (lambda: built(Recurrent(0), ("x", 2, NOW)), "at least 1"),
    (lambda: built(Recurrent(stack=True), ("x", 2, BEFORE)), "stack"),
    (lambda: built(Dense(), ("z", 2, BEFORE)), "single steps"),
    (lambda: built(Dense((3, 0)), ("x", 2, NOW)), "at least 1"),
    (lambda: built(Linear(3), ("z", 2, NOW))({"z": torch.zeros(1, 5, 2)}, 5), "steps"),
    (lambda: tie(built(Recurrent(4), ("x", 2, BEFORE)), built(Attention(8, 2), ("x", 2, NOW))), "can be tied"),
    (lambda: tie(*(built(Recurrent(n), ("x", 2, BEFORE)) for n in (4, 5))), "differ in parents"),
    (lambda: built(CosineEncoder(6), ("s", 9, None)), "exactly one static parent"),
    (lambda: built(CosineEncoder(6), ("y", 9, BEFORE), ("s", 9, None)), "all steps"),
    (lambda: built(CosineDecoder(6), ("z", 4, ALL), ("s", 8, None), size=9), "size"),
    (lambda: built(GraphConv({"h": range(5), "x": (0, 3)}, "x", 9, 3), ("h", 15, ALL), size=5), "size"),
    (lambda: built(GraphConv({"h": range(5), "x": (0, 3)}, "x", 9, 3), ("h", 12, ALL), size=6), "size"),
    (lambda: built(GraphConv({"h": range(5), "x": (0, 3)}, "x", 9, 3), ("h", 15, BEFORE), size=6), "h is read at"),
    (lambda: built(GraphConv({"h": range(5), "x": (0, 3)}, "x", 9, 10), ("h", 15, ALL), size=6), "coefficients"),
    (lambda: built(WholeDecoder(4, sizes={"a": 2}, name="a"), ("z", 3, None), size=3), "share"),
    (lambda: model(network={"p(x)": WholeDecoder(5)}), "static"),
    (lambda: model(DKF, network=LinearSDE()), "parents"),
    (lambda: model(GAPS, {"z": 2, "x": 2, "d": 1}, network={"p(z)": LinearSDE()}), "Triangular"),
    (lambda: model(GAPS, {"z": 2, "x": 2, "d": 1}, network={"q": LinearSDEGuide(gap="x")}), "gap"),
    (lambda: Equation(2, (2.0, 1.0)), "positive"),
    (lambda: model(NOISY, {"z": 2, "x": 3, "s": 2}, network={"p(x)": WithNoise("s", Dense((4,)))}), "scale"),
    (lambda: model(NOISY, {"z": 2, "x": 3, "s": 3}, network={"p(x)": WithNoise("s", Dense((4,)))}), "KnownNoise"),
]
DISTRIBUTIONS = [
    (lambda: ConditionalFlow(0).build(Shape(2, 1)), "at least 1"),
    (lambda: QRFlow(0).build(Shape(2, local=False)), "layers"),
    (lambda: QRFlow(2).build(Shape(5, local=False)).to_noise(torch.zeros(2, 4)), "takes"),
    (lambda: QRFlow(2).build(Shape(5, local=False)).whiten(torch.zeros(5, 5)), "values"),
    (lambda: Family("Poison").build(Shape(2, 3)), "Poisson"),
    (lambda: Family("Poisson", given={"rat": 1}).build(Shape(2, 3)), "rate"),
    (lambda: Family("Poisson", given={"rate": 1.0}).build(Shape(2, 3)), "left to be read"),
    (lambda: Family("Poisson", residual=1.0).build(Shape(2, 3)), "location"),
    (lambda: Family("Uniform").build(Shape(2, 3)), "parameters"),
    (lambda: NormalMixture(0).build(Shape(2, 3)), "at least 1"),
    (lambda: StudentT(df=2.0).build(Shape(2, 2)), "variance"),
    (lambda: FixedNormal(project=False).build(Shape(2, 3)), "features"),
    (lambda: FixedNormal(scale=0.0).build(Shape(2, 2)), "positive"),
    (lambda: FixedNormal(steps=2).build(Shape(2, 2, local=False)), "static"),
    (lambda: FixedNormal(steps=2).build(Shape(2, 2))(torch.zeros(2, 3, 2)), "steps"),
    (lambda: Normal(residual=1.1).build(Shape(2, 2)), "share"),
    (lambda: model(distributions={"p(x)": Normal(residual=True)}), "residual"),
    (lambda: prior(Vamp(), "q(w) q(z_t | x_{1:T})"), "guide"),
    (lambda: prior(Mixture(), key="p(z)"), "static latents"),
    (lambda: prior(Mixture(), None), "reparameterised"),
]
PROGRAMS = [
    (lambda: model(sizes={"z": 2}), "missing"),
    (lambda: model(sizes={"z": 0, "x": 3}), "at least 1"),
    (lambda: model(sizes={"z": "2", "x": 3}), "whole number"),
    (lambda: DynamicalVAE(*DKF, 3), "size"),
    (lambda: model(network=Dense), "class"),
    (lambda: model(network="gru"), "description"),
    (lambda: model(network={"p(y)": Dense()}), "factor"),
    (lambda: model(distributions=StudentT), "class"),
    (lambda: model(view=views.View), "class"),
    (lambda: model(("p(keys_t) p(x_t | keys_t)", "q(keys_t | x_t)"), {"keys": 1, "x": 1}), "keys"),
    (lambda: model((DKF[0], "q(u_t | x_t)")), "latent"),
    (lambda: MODEL.model(X[..., :2]), "shape"),
    (lambda: MODEL.model(X[:, :0]), "no steps"),
    (lambda: MODEL.model(X[:0]), "no sequences"),
    (lambda: MODEL.model({"x": X, "label": X}), "label"),
    (lambda: MODEL.model({"x": X, "z": Y[:2]}), "sequences"),
    (lambda: MODEL.model({"x": X[:, :4], "z": Y}), "steps"),
    (lambda: MODEL.model(), "length"),
    (lambda: MODEL.model(length=0), "at least 1"),
    (lambda: MODEL.model(X, length=4), "steps"),
    (lambda: MODEL.model({"x": X, "mask": X}), "bool"),
    (lambda: MODEL.model({"x": X, "mask": {"y": X == 0}}), "mask of y"),
    (lambda: MODEL.model({"x": X, "lengths": torch.tensor([5, 6, 1])}), "lengths"),
    (lambda: MODEL.model(X / 0), "finite"),
    (lambda: MODEL.model(X, scheduled_sampling=1.5), "probability"),
    (lambda: MODEL.guide({"z": Y}), "reads x"),
    (lambda: MODEL.log_joint(X, {}), "latent"),
    (lambda: MODEL.log_joint(X, {"z": X}), "shape"),
    (lambda: MODEL.forecast(X, 0), "horizon"),
    (lambda: MODEL.forecast(X, 1, 0), "samples"),
    (lambda: MODEL.forecast({"x": X, "lengths": torch.tensor([5, 5, 5])}, 2), "one length"),
    (lambda: TWO.model(X), "mapping"),
    (
        lambda: poutine.condition(
            linear_gaussian_surrogate(
                "p(x_t | x_{t-1}, z_t) p(z_t | x_{t-1})", "q(z_t | x_{1:T})", {"z": 1, "x": 3}, T
            ).model,
            {"x": X},
        )(length=T, size=3),
        "pass x",
    ),
    (lambda: model(GAPS, {"z": 2, "x": 3, "d": 1}).double().guide(X), "context"),
    (lambda: ScheduledSampling(1.0, blocks=(0, 5)), "blocks"),
    (lambda: InputNoise(math.nan), "finite"),
    (lambda: model(DKF, indicators=("z",)), "indicators"),
    (lambda: model(GROUPED, {"g": 2, "w": 2, "x": 3}, grouped=("x",)), "must name static latents"),
    (lambda: model(GROUPED, {"g": 2, "w": 2, "x": 3}, grouped=("w",)), "reads"),
    (lambda: MODEL.impute({"x": X, "mask": X == 0}, 3, particles=0), "particles"),
    (lambda: Discrete(1), "states"),
    (lambda: model(("p(k_t | k_{<t}) p(x_t | k_t)", ""), {"k": Discrete(3), "x": 2}), "cannot be summed out"),
    (lambda: model(("p(k_t | k_{t-1}) p(x_t | k_{1:T})", ""), {"k": Discrete(3), "x": 2}), "summed out"),
    (lambda: model(("p(k_t | k_{t-9}) p(x_t | k_t)", ""), {"k": Discrete(3), "x": 2}), "but a sum supports at most"),
    (lambda: model(("p(k_t) p(x_t | k_t)", "q(k_t | x_t)"), {"k": Discrete(3), "x": 2}), "summed out"),
    (lambda: model(STATES, {"k": Discrete(3), "x": 2}, distributions={"p(k)": Normal()}), "categorical"),
    (lambda: dvae.iwae_bound(SUMMED, {"x": Y, "mask": Y > 0}, 1), "means"),
    (lambda: MODEL.states(X), "sums out no latent"),
    (lambda: model_kl_gap(DKF[0], "p(x_t)", {"z": 1, "x": 1}), "variables"),
    (lambda: model_kl_gap(DKF[0], DKF[0], {"z": 1, "x": 1}, steps=0), "at least 1"),
    (lambda: Oracle(MODEL, T).gap(), "linear-Gaussian"),
    (lambda: Oracle(LINEAR, "4"), "steps"),
    (lambda: Oracle(DynamicalVAE, T), "class"),
    (
        lambda: Oracle(
            linear_gaussian_surrogate("p(z_t | c_t) p(x_t | z_t)", "q(z_t | x_t)", dict.fromkeys("zxc", 1), T), T
        ),
        "context",
    ),
    (lambda: Oracle(LINEAR, T).evidence(X[:, :3, :1]), "steps"),
    (lambda: model().filter(dvae.ArrayWindows(X, observed=1)), r"got ArrayWindows, .* `windows.all\(\)`"),
    (floored, "logarithms"),
]


@pytest.mark.parametrize("table", [NETWORKS, DISTRIBUTIONS, PROGRAMS], ids=["networks", "distributions", "programs"])
def test_misuse_is_an_error(table):
    for call, word in table:
        with pytest.raises((TypeError, ValueError), match=word):
            call()
