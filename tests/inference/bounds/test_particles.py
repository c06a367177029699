"""The particle bound: unbiased for the evidence, the textbook's filter, and every network's state moved with it."""

import math

import pyro
import pytest
import torch
from pyro import poutine

from dvae import DynamicalVAE, Oracle, SequenceELBO, distributions, importance_bound, particle_bound, twin
from dvae.factorization.notation import Factorization
from dvae.factorization.relations import Relation
from dvae.inference.bounds.particles import Filter, ancestors, effective_size
from dvae.networks import Attention, Dense, Input, Linear, LinearSDE, LinearSDEGuide, Recurrent, WithNoise
from dvae.networks.rows import Rows, select
from dvae.program.batch import repeat

T = 5
PAIRS = {
    "dkf": ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})"),
    "srnn": ("p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"),
    "vrnn": ("p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{<=t}, z_{<t})"),
    "static": ("p(w) p(z_t | z_{<t}) p(x_t | z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"),
    "two layers": (
        "p(w) p(u_t | u_{t-1}, w) p(z_t | z_{t-1}, u_t) p(x_t | x_{<t}, z_t)",
        "q(w | x_{1:T}) q(u_t | u_{t-1}, z_{t-1}, x_{1:T}, w) q(z_t | z_{t-1}, u_t, x_{1:T}, w)",
    ),
    "static drawn last": (
        "p(w) p(z_t | z_{<t}, w) p(v | z_{1:T}, w) p(x_t | z_t)",
        "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}) q(v | z_{1:T}, x_{1:T}, w)",
    ),
    "context": ("p(z_t | z_{t-1}, c_t, b) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T}, c_t)"),
}
SIZES = {"w": 2, "v": 1, "u": 1, "z": 2, "x": 3, "c": 2, "b": 1}
NETWORKS = {
    "linear": Linear(T),
    "lstm": Recurrent(4, hidden=(5,)),
    "gru": Recurrent(3, cell="gru", layers=2, embed=3, hidden=(4,)),
    "attention": Attention(8, heads=2, layers=2),
    "dense": Dense((5,)),
}
# Dense reads single steps only.
MODELS = [(pair, kind) for pair in PAIRS for kind in NETWORKS if kind != "dense"] + [("dkf", "dense")]


def names(equations):
    factorization = Factorization.parse(equations)
    return [*factorization.variables, *factorization.context]


def build(pair, kind, **options):
    p, q = PAIRS[pair]
    if kind == "dense":
        q = q.replace("x_{1:T}", "x_t")
    return DynamicalVAE(p, q, {name: SIZES[name] for name in names(p)}, NETWORKS[kind], **options).double()


def data(model, batch=3, **more):
    locals_ = {"x": SIZES["x"], "c": SIZES["c"]}
    sizes = {name: SIZES[name] for name in (*model.observed, *model.context)}
    shapes = {n: (batch, T, d) if n in locals_ else (batch, d) for n, d in sizes.items()}
    return {**{name: torch.randn(shape, dtype=torch.float64) for name, shape in shapes.items()}, **more}


def gaps(batch=3):
    mask = torch.rand(batch, T, SIZES["x"]) > 0.3
    mask[0, 1] = False
    return {"mask": mask}


BATCHES = {"whole": dict, "ragged": lambda: {"lengths": torch.tensor([T, 1, 3])}, "gaps": gaps}
CASES = [(*model, list(BATCHES)[place % 3]) for place, model in enumerate(MODELS)]
"""Every model with one kind of batch."""


def bounded(pair, seed=1):
    """A twin whose guide is the best of its factorization, spread a little: its weights have light tails."""
    model = twin(*PAIRS[pair], dict.fromkeys(names(PAIRS[pair][0]), 1), T, seed, scale=0.5)
    Oracle(model, T).fit_guide(100)
    with torch.no_grad():
        for conditional in model.encoder.values():
            conditional.law.log_scale.add_(0.2)
    return model


# ------------------------------------------------------------------------------------------------------------ oracle


@pytest.mark.parametrize("pair", [pair for pair in PAIRS if pair != "context"])
def test_it_is_unbiased_for_the_evidence(pair):
    model = bounded(pair)
    x = model.sample(500, T)["x"].mean(0, keepdim=True)  # data far out give heavy tails, and errors without meaning
    with torch.no_grad():
        evidence = Oracle(model, T).evidence(x)
    n = 3000
    for resample_below in (0.0, 0.7, 1.0):
        out = particle_bound(model, x.repeat(n, 1, 1), 4, resample_below=resample_below, chunk=4 * n)
        ratio = (out.bound - evidence).exp()
        assert abs(ratio.mean() - 1) < 4 * ratio.std() / n**0.5 < 0.25
        assert (out.resamplings > 0).any() == (resample_below > 0)


@pytest.mark.parametrize("pair", ["vrnn", "two layers"])
def test_one_particle_is_the_evidence_lower_bound_and_more_are_closer_to_the_evidence(pair):
    model = bounded(pair)
    x = model.sample(1, T)["x"]
    with torch.no_grad():
        exact, evidence = Oracle(model, T).bound(x).item(), Oracle(model, T).evidence(x).item()
    n = 1000
    for estimate in (particle_bound, importance_bound):
        means, errors = [], []
        for particles in (1, 5, 25):
            bounds = estimate(model, x.repeat(n, 1, 1), particles, chunk=n * particles).bound
            means.append(bounds.mean().item())
            errors.append(bounds.std().item() / n**0.5)
        assert abs(means[0] - exact) < 4.5 * errors[0]
        for before, after, error in zip(means, means[1:], errors, strict=False):
            assert after > before - 4.5 * error
        assert means[-1] <= evidence + 4.5 * errors[-1]
        assert evidence - means[-1] < 0.4 * (evidence - exact)


def test_the_exact_posterior_never_resamples_and_gives_the_evidence():
    model = twin(*PAIRS["srnn"], {"z": 1, "x": 2}, T)
    assert Oracle(model, T).fit_guide() < 1e-10
    x = model.sample(5, T)["x"]
    out = particle_bound(model, x, 8, chunk=16)
    torch.testing.assert_close(out.bound, Oracle(model, T).evidence(x).detach(), rtol=0, atol=1e-3)
    assert (out.resamplings == 0).all()
    # On the way the particles are weighed for x_{1:t}, but drawn for x_{1:T}: only at the end are their weights equal.
    assert (out.effective[-1] > 7.9999).all()


@pytest.mark.parametrize("guide", ["q(z_t | z_{t-1})", "q(z_t | z_{t-1}, x_t)"])
def test_on_long_sequences_it_is_tighter_than_importance_weighting(guide):
    steps, sizes = 100, {"z": 1, "x": 1}
    model = twin("p(z_t | z_{t-1}) p(x_t | z_t)", guide, sizes, steps, scale=0.5)
    with torch.no_grad():  # the prior as the guide, which may then lean towards x_t
        p, q = model.generator["z"], model.encoder["z"]
        q.network.bias.copy_(p.network.bias)
        q.network.weights["z"].copy_(p.network.weights["z"])
        q.law.log_scale.copy_(p.law.log_scale)
        if "x" in q.network.weights:
            q.network.weights["x"].zero_()
            q.law.log_scale.sub_(0.05)
        x = model.sample(20, steps)["x"]
        evidence = Oracle(model, steps).evidence(x)
        before = -math.inf
        for particles in (4, 16, 64):
            filtered = particle_bound(model, x, particles).bound
            weighted = importance_bound(model, x, particles).bound
            difference = filtered - weighted
            assert difference.mean() > 4 * difference.std() / 20**0.5
            assert before < filtered.mean() < evidence.mean()
            before = filtered.mean()
        assert (evidence - filtered).mean() < 0.1 * (evidence - weighted).mean()


# ---------------------------------------------------------------------------------------------- the program's weights


def weights(model, batch, latents):
    """log p(x, z) - log q(z | x), (N,), by the vectorised program."""
    trace = poutine.trace(poutine.condition(model.guide, data=latents)).get_trace(batch)
    trace.compute_log_prob()
    return sum(model.log_joint(batch, latents).values()) - sum(trace.nodes[n]["log_prob"] for n in model.latents)


@torch.no_grad()
@pytest.mark.parametrize(("pair", "kind", "extra"), CASES)
def test_without_resampling_it_weighs_its_draws_as_the_program_does(pair, kind, extra):
    model, particles = build(pair, kind), 4
    batch = data(model, **BATCHES[extra]())
    run = Filter(model, batch, particles)
    out = run.run(0.0)
    latents = {name: value for name, value in run.drawn.items() if name in model.latents}
    expected = weights(model, repeat(batch, particles), latents).unflatten(0, (particles, -1))
    torch.testing.assert_close(out.bound, expected.logsumexp(0) - math.log(particles))
    assert not out.resamplings.any()
    if extra == "ragged":
        for i, n in enumerate(batch["lengths"].tolist()):
            alone = {name: v[i::3, :n] if v.dim() == 3 else v[i::3] for name, v in latents.items()}
            cut = {k: v[i : i + 1, :n] if v.dim() == 3 else v[i : i + 1] for k, v in batch.items() if k != "lengths"}
            torch.testing.assert_close(weights(model, repeat(cut, particles), alone), expected[:, i])
            assert out.effective[:, i].isnan().tolist() == [t >= n for t in range(T)]


def textbook(model, batch, particles, resample_below):
    """The same filter with every conditional evaluated from scratch at every step, on draws moved by hand."""
    everyone = repeat(model.read(batch), particles)
    latents, n = {}, len(everyone["x"])

    def program(factorization, conditionals):
        rollout = model._rollout(factorization, conditionals, everyone, None, 1)
        rollout.values.update(latents)
        return rollout

    def guide():
        return program(model.inference, model.encoder)

    def generator():
        return program(model.generative, model.generator)

    def draw(law, noise):
        return law.loc + law.scale * noise

    weight = torch.zeros(n, dtype=torch.float64)
    statics = [name for name in model.latents if not model.generative.local(name)]
    last = [name for name in statics if "z" in model.encoder[name].parents]
    shape = particles, len(batch["x"])
    bound, count = torch.zeros(shape[1], dtype=torch.float64), torch.zeros(shape[1], dtype=torch.long)

    def draw_static(name):
        law = guide().law(name)
        latents[name] = draw(law.base_dist, torch.randn(n, model.sizes[name], dtype=torch.float64))
        return generator().law(name).log_prob(latents[name]) - law.log_prob(latents[name])

    for name in (name for name in statics if name not in last):
        weight = weight + draw_static(name)
    moving = [name for name in model.latents if name not in statics]
    noise = {name: torch.randn(n, T, model.sizes[name], dtype=torch.float64) for name in moving}
    latents |= {name: torch.zeros_like(value) for name, value in noise.items()}
    lengths = batch.get("lengths", torch.full((shape[1],), T))
    for t in range(T):
        low = (effective_size(weight.view(shape)) < resample_below * particles) & (t < lengths)
        if (t or statics) and low.any():
            bound = bound + torch.where(low, weight.view(shape).logsumexp(0) - math.log(particles), 0.0)
            rows = ancestors(weight.view(shape), low)
            latents = {name: value[rows] for name, value in latents.items()}
            weight = weight.view(shape).masked_fill(low, 0).flatten()
            count += low
        total = torch.zeros(n, dtype=torch.float64)
        for name in moving:
            law = guide().evaluate(name, latents[name].clone())
            latents[name][:, t] = draw(law, noise[name])[:, t]
            total -= law.log_prob(latents[name])[:, t].sum(-1)
        rollout = generator()
        for name in (*moving, *model.observed):
            value = rollout.values[name].clone()
            entries = rollout.evaluate(name, value).log_prob(value)[:, t]
            mask = rollout.mask(name)
            total += (entries if name in moving or mask is None else entries * mask[:, t]).sum(-1)
        weight = weight + total * (t < lengths).repeat(particles)
    for name in moving:
        latents[name] = latents[name] * (torch.arange(T) < lengths[:, None])[..., None].repeat(particles, 1, 1)
    for name in last:
        weight = weight + draw_static(name)
    return bound + weight.view(shape).logsumexp(0) - math.log(particles), count


@torch.no_grad()
@pytest.mark.parametrize(("pair", "kind", "extra"), CASES)
def test_it_is_the_textbooks_filter(pair, kind, extra):
    model = build(pair, kind)
    batch = data(model, **BATCHES[extra]())
    for below in (0.6, 1.0):
        if below == 1.0:
            model.standardise("z").double().fit(2 + 3 * torch.randn(9, 2, dtype=torch.float64))
        pyro.set_rng_seed(3)
        bound, count = textbook(model, batch, 4, below)
        pyro.set_rng_seed(3)
        out = particle_bound(model, batch, 4, resample_below=below)
        torch.testing.assert_close(out.bound, bound, rtol=0, atol=1e-9)
        assert torch.equal(out.resamplings, count)
    assert count.sum() > 3


GIVEN = {
    "with noise": (
        "q(z_t | z_{t-1}, x_t)",
        {"p(x)": WithNoise("s", Dense((4,)))},
        {"p(x)": distributions.KnownNoise()},
    ),
    "irregular times": (
        "q(z_t | z_{t-1}, x_t, d_t)",
        {"p(z)": LinearSDE(), "q(z)": LinearSDEGuide()},
        {"p(z)": distributions.Triangular(), "q(z)": distributions.Triangular()},
    ),
}


@pytest.mark.parametrize("case", GIVEN)
def test_units_of_mean_zero_and_scale_one_change_no_bound(case):
    guide, networks, distributions = GIVEN[case]
    sizes = {"z": 2, "x": 3, "d": 1, "s": 3}
    noisy = case == "with noise"
    pair = ("p(z_t | z_{t-1}) p(x_t | z_t, s_t)" if noisy else "p(z_t | z_{t-1}, d_t) p(x_t | z_t)", guide)
    sizes.pop("d" if noisy else "s")
    model = DynamicalVAE(*pair, sizes, {"default": Dense((4,)), **networks}, distributions).double()
    batch = {name: torch.rand(2, T, sizes[name], dtype=torch.float64) + 0.1 for name in ("x", *model.context)}
    bounds = []
    for standardised in (False, True):
        if standardised:
            model.standardise("z").double()
        pyro.set_rng_seed(2)
        bounds.append(particle_bound(model, batch, 4, resample_below=1.0).bound)
    torch.testing.assert_close(*bounds)


@torch.no_grad()
def test_laws_of_every_kind():
    options = {
        "p(x)": distributions.Normal(residual=True),
        "p(z)": distributions.StudentT(),
        "q(z)": distributions.Normal(residual=True),
    }
    model = DynamicalVAE(
        "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{<t}, z_t)",
        "q(w | x_{1:T}) q(z_t | z_{<t}, x_{1:T}, w)",
        {"w": 2, "z": 2, "x": 3},
        NETWORKS["lstm"],
        {**options, "p(w)": distributions.Mixture(3)},
    ).double()
    for extra in BATCHES.values():
        batch = data(model, **extra())
        run = Filter(model, batch, 4)
        bound = run.run(0.0).bound
        latents = {name: value for name, value in run.drawn.items() if name in model.latents}
        expected = weights(model, repeat(batch, 4), latents).unflatten(0, (4, -1))
        torch.testing.assert_close(bound, expected.logsumexp(0) - math.log(4))


def test_what_lies_in_the_padding_is_unseen():
    model = build("two layers", "lstm")
    lengths = torch.tensor([T, 1, 3])
    batch = data(model, lengths=lengths)
    garbage = {**batch, "x": torch.where((torch.arange(T) < lengths[:, None])[..., None], batch["x"], math.nan)}
    bounds = []
    for given in (batch, garbage):
        pyro.set_rng_seed(2)
        bounds.append(particle_bound(model, given, 6).bound)
    assert torch.equal(*bounds)


# ----------------------------------------------------------------------------------------------------------- networks

KINDS = {
    **NETWORKS,
    "linear": Linear(8),
    "lstm, two layers": Recurrent(4, layers=2, hidden=(5, 3)),
    "lstm, extractors": Recurrent(4, hidden=(5,), separate=True, extract={"z": (3,), "x": (3, 2), "v": (2,)}),
    "attention, one layer": Attention(8, heads=4),
}
RANGED = {"z": "<t", "y": "t-2:t", "u": "<=t-2", "v": "t-1", "x": "<t", "s": "1:T"}
POINTWISE = {"z": "t-1", "y": "t-2:t", "u": "t-3", "v": "t-1", "x": "t-2:t-1", "s": "t-1:t+1"}


@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_state_moves_to_other_rows_of_the_batch(kind, gradient):
    steps, given = 7, ["x", "s", "w"]
    relations = POINTWISE if kind == "dense" else RANGED
    inputs = [Input(name, 2, Relation.parse(text)) for name, text in relations.items()] + [Input("w", 2)]
    network = KINDS[kind].build(inputs, True, 2).double()
    for batch, lengths in ((3, None), (3, torch.tensor([7, 2, 5])), (1, None)):
        shapes = {p.name: (batch, 2) if p.relation is None else (batch, steps, 2) for p in inputs}
        values = {name: torch.randn(shape, dtype=torch.float64) for name, shape in shapes.items()}
        if lengths is not None:
            pad = torch.arange(steps) >= lengths[:, None]
            values |= {n: v.masked_fill(pad[..., None], 0) for n, v in values.items() if v.dim() == 3}
        chosen = {0: torch.arange(batch).repeat(2)}
        n = len(chosen[0])
        chosen |= {t: torch.randint(n, (n,)) for t in (2, 3, 5)} | {6: torch.arange(n)}
        with torch.set_grad_enabled(gradient):
            state = network.start({name: values[name] for name in given}, batch, steps, lengths)
            live = [name for name in relations if name not in given]
            drawn, features = {name: Rows([None] * steps) for name in live}, Rows([None] * steps)
            for t in range(steps):
                if t in chosen:
                    state = network.select(state, chosen[t])
                    drawn, features = select((drawn, features), chosen[t])
                    values = {name: value[chosen[t]] for name, value in values.items()}
                    lengths = None if lengths is None else lengths[chosen[t]]
                    if lengths is None:  # particles differ in what they draw from here
                        fresh = torch.randn(n, steps - t, 2, dtype=torch.float64)
                        values |= {name: torch.cat([values[name][:, :t], fresh], 1) for name in live}
                drawn["y"][t] = values["y"][:, t]
                features[t], state = network.step(state, t, drawn)
                for name in live:
                    drawn[name][t] = values[name][:, t]
            together = network(values, steps, lengths)
        valid = torch.ones(n, steps) if lengths is None else torch.arange(steps) < lengths[:, None]
        got = torch.stack(list(features), 1)
        torch.testing.assert_close(got * valid[..., None], together * valid[..., None], rtol=0, atol=1e-10)


def test_systematic_resampling_keeps_every_particle_about_as_often_as_it_weighs():
    log_weights = torch.randn(6, 4, dtype=torch.float64)
    log_weights[2, 1] = -math.inf
    share = log_weights.softmax(0)
    counts = torch.zeros(6, 4, dtype=torch.float64)
    for _ in range(1000):
        rows = ancestors(log_weights, torch.tensor([True, True, True, False])).view(6, 4)
        assert torch.equal(rows % 4, torch.arange(4).expand(6, 4))
        count = torch.stack([torch.bincount(column // 4, minlength=6) for column in rows.t()], 1)
        assert (count[:, 3] == 1).all()
        assert ((count - 6 * share).abs()[:, :3] < 1).all()
        counts += count / 1000
    torch.testing.assert_close(counts[:, :3], 6 * share[:, :3], rtol=0, atol=0.06)


@pytest.mark.parametrize("far", [1e4, -1e6])
def test_the_effective_size_depends_on_differences_of_log_weights_alone(far):
    """In float32; the differences are multiples of 1/8, which it holds at a million."""
    log_weights = (8 * torch.randn(16, 40)).round() / 8
    expected = effective_size(log_weights.double())
    assert expected.std() > 1
    torch.testing.assert_close(effective_size(log_weights + far).double(), expected, rtol=1e-5, atol=0)


def test_the_effective_size_is_between_one_and_all():
    assert effective_size(torch.zeros(5, 2)).tolist() == pytest.approx([5.0, 5.0])
    one = torch.full((5, 1), -math.inf)
    one[3] = -4000.0
    assert effective_size(one).item() == pytest.approx(1.0)


# ------------------------------------------------------------------------------------------------------------- misuse


@pytest.mark.parametrize(
    ("p", "q", "message"),
    [
        ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t+1}, x_t)", "the guide draws z backward"),
        ("p(z_t) p(x_t | z_{1:T})", "q(z_t | z_{<t}, x_t)", r"p\(x_t \| z_\{1:T\}\) reads z_\{1:T\}, and z after t"),
        (
            "p(u_t) p(z_t | u_t) p(x_t | z_t)",
            "q(u_t | x_t) q(z_t | u_{>=t})",
            "reads u_{>=t}, and u after t is not drawn",
        ),
        (
            "p(w) p(z_t | w) p(x_t | z_t)",
            "q(w | z_{1:T}) q(z_t | x_t)",
            r"p\(z_t \| w\) reads w, which q\(w \| z_\{1:T\}\) draws after all steps",
        ),
    ],
)
def test_what_has_no_order_in_time_is_refused(p, q, message):
    model = DynamicalVAE(p, q, dict.fromkeys(names(p), 1), Linear(T)).double()
    with pytest.raises(ValueError, match=message + ".*use importance_bound"):
        particle_bound(model, data(model)["x"][..., :1])


def test_data_that_are_read_ahead_have_no_missing_entries():
    model = DynamicalVAE("p(x_t | x_{<t}) p(z_t | x_{1:T})", "q(z_t | x_{1:T})", {"z": 1, "x": 3}, Linear(T)).double()
    batch = data(model)
    assert particle_bound(model, batch).bound.isfinite().all()
    with pytest.raises(ValueError, match="x after t is not drawn yet where entries are missing"):
        particle_bound(model, {**batch, **gaps()})


def test_bad_arguments_are_refused():
    model = build("context", "linear")
    with pytest.raises(ValueError, match="the bound needs x, c, b; missing in the batch are c, b"):
        particle_bound(model, data(model)["x"])
    with pytest.raises(ValueError, match="particles is a whole number, at least 1, not 0"):
        particle_bound(model, data(model), 0)
    with pytest.raises(ValueError, match=r"resample_below is a share .*, got 1.5"):
        particle_bound(model, data(model), resample_below=1.5)


def test_evaluation_leaves_the_mode_and_takes_no_gradient():
    model = build("two layers", "attention").train()
    out = particle_bound(model, data(model), 3, chunk=6)
    assert model.training
    assert not out.bound.requires_grad
    assert out.bound.shape == out.resamplings.shape == (3,)
    assert out.effective.shape == (T, 3)
    assert out.particles == 3
    assert ((out.effective >= 1 - 1e-9) & (out.effective <= 3 + 1e-9)).all()
    assert SequenceELBO().terms(model, data(model)).bound.requires_grad
