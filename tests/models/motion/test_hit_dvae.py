"""HiT-DVAE: dependencies of the model, the objective of the paper, forecasts, runs and ablations."""

import math
from dataclasses import replace

import pytest
import torch
from pyro import poutine

import dvae
from dvae import motion
from dvae.distributions import FixedNormal
from dvae.models.motion.hit_dvae import OURS, PRESETS, PUBLISHED, HiTModel
from dvae.models.registry import configured
from dvae.motion.data.protocols import Poses
from dvae.motion.geometry.parts import body_parts
from dvae.motion.scoring import energies
from dvae.networks import FrameGraph, NodeGraph
from dvae.runs import directory as runs

SMALL = {"latent": 3, "static": 2, "width": 8, "heads_count": 2, "decoder": 8, "pose_width": 2, "samples": 3}
QUICK = {**SMALL, "pose_prior": 0.0, "angles": 0.0, "multimodal": 0.0, "heading": False}
ABLATIONS = {
    "whole": {},
    "without attention and w": {"attention": False, "static": 0},
    "with its past, attention-pooled": {"guide_past": True, "summary": "attention"},
    "queries as in the paper, of poses as they are": {"nearest": False, "pose_width": 0},
    "evidence, turned": {"loss": "evidence", "heading": True},
    "published": {"published": True},
}
ENERGIES = {"samples": None, "pose_prior": None, "angles": None, "multimodal": None}


def build(windows, **options):
    torch.manual_seed(0)
    return small(**options).resolve_defaults(windows).build(windows).double()


def small(**options):
    """Return the method at test size; the evidence ignores the options of best-of-many."""
    return dvae.method("hit-dvae", **{**QUICK, **(ENERGIES if options.get("loss") == "evidence" else {}), **options})


def batch_of(windows, size=3, **options):
    method = small(**options)
    batch = method.train(windows).batches.sample(size, torch.Generator().manual_seed(0))
    return {name: v.double() if v.is_floating_point() else v for name, v in batch.items()}


def terms(model, batch, **program):
    objective = model.method.objective()
    return dvae.SequenceELBO().terms(model, batch, draws=objective.draws, **program), objective


# -------------------------------------------------------------------------------------------------- dependencies


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_the_model_reads_nothing_from_the_present_or_the_future(windows, ablation):
    """x_t changes no p(x_s | .) and no p(z_s | .) with s <= t; z_t changes no p(z_s | .) with s <= t.

    The exception is a model that rotates windows by the heading of a frame, here the last. All joints of that frame
    are moved equally, which keeps the heading.
    """
    model, steps = build(windows, **ABLATIONS[ablation]).eval(), 6
    is_rotated = isinstance(model, HiTModel) and model.method.heading
    x = batch_of(windows)["x"][:1, :steps]
    latents = model.guide(x)

    def means(x, z):
        sites = poutine.trace(poutine.condition(model.model, data={**latents, "z": z})).get_trace(x).nodes
        return [sites[name]["fn"].steps(sites[name]["value"]) for name in ("x", "z")]

    def changed_steps(x, z):
        before, after = means(x0, z0), means(x, z)
        differences = [
            (a.loc - b.loc).abs().amax((0, 2)) + (a.scale - b.scale).abs().amax((0, 2))
            for a, b in zip(before, after, strict=True)
        ]
        return [values.gt(0).tolist() for values in differences]

    x0, z0 = x, latents["z"]
    for t in range(steps):
        x, z = x0.clone(), z0.clone()
        x[:, t] += 0.1 * (1 if is_rotated and t == steps - 1 else torch.randn_like(x[:, t]))
        z[:, t] += 0.1 * torch.randn_like(z[:, t])
        of_x, of_z = changed_steps(x, z0)
        assert of_x == [s > t for s in range(steps)]
        assert of_z == [s == t + 1 for s in range(steps)]
        of_x, of_z = changed_steps(x0, z)
        assert of_x == [s == t for s in range(steps)]
        assert of_z == [s > t for s in range(steps)]


def test_the_equations_are_those_of_the_paper_and_its_ablations():
    def texts(**options):
        return tuple(equation.text for equation in dvae.method("hit-dvae", **options).equations())

    p, q = "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"
    assert texts() == (p, q)
    assert texts(guide_past=True) == (p, "q(w | x_{1:T}) q(z_t | z_{<t}, x_{1:T}, w)")
    assert texts(static=0) == ("p(z_t | z_{<t}, x_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | x_{1:T})")


# -------------------------------------------------------------------------------------------------- the objective


@pytest.mark.parametrize("published", [False, True])
def test_the_loss_equals_the_one_of_the_paper(windows, published):
    """The terms of L are means over time and sums over coordinates, computed window by window.

    In the published model x_1 is given, and the KL of z begins at z_2.
    """
    options = {"angles": 2.0, "multimodal": 3.0, "heading": True, "warm_up": 0, "pseudo_minimum": 0.0}
    options["published"] = published
    model, batch = build(windows, **options).eval(), batch_of(windows, **options)
    assert batch["valid"].any()
    result, objective = terms(model, batch)
    latents = poutine.trace(model.guide).get_trace
    torch.manual_seed(1)
    sites = latents(batch, draws=objective.draws).nodes
    torch.manual_seed(1)
    result, _ = terms(model, batch)
    K, B, T = 3, 3, 75
    z, w = (sites[name]["value"] for name in ("z", "w"))
    x, pseudo = (model.turned(batch[name]) for name in ("x", "pseudo"))
    repeated = {"x": batch["x"].repeat(K, 1, 1)}
    program = poutine.trace(poutine.condition(model.model, data={"z": z, "w": w})).get_trace(repeated).nodes
    motions = program["x"]["fn"].steps(x.repeat(K, 1, 1)).loc.unflatten(0, (K, B))
    first = int(published)
    if published:
        motions = torch.cat([x[None, :, :1].expand(K, -1, -1, -1), motions[:, :, 1:]], 2)

    def kl(name):
        p, q = (nodes[name]["fn"] for nodes in (program, sites))
        if name == "z":
            p, q = p.steps(z), q.steps(z)
        return torch.distributions.kl_divergence(getattr(q, "base_dist", q), getattr(p, "base_dist", p)).unflatten(
            0, (K, B)
        )

    method = model.method
    L = (
        method.reconstruction
        * torch.stack([min(((motions[k, b] - x[b]) ** 2).sum(-1).mean() for k in range(K)) for b in range(B)]).mean()
    )
    pairs = batch["valid"].nonzero().tolist()
    best = [min(((motions[k, b] - pseudo[b, m]) ** 2).sum(-1).mean() for k in range(K)) for b, m in pairs]
    L += method.multimodal * torch.stack(best).mean()
    L += (
        method.kl_local / T * kl("z")[:, :, first:].sum((-2, -1)).mean() + method.kl_static / T * kl("w").sum(-1).mean()
    )
    lengths, true_lengths = (windows.skeleton.bone_lengths(windows.positions(v)) for v in (motions, x[:, :1]))
    L += method.limb * ((lengths - true_lengths) ** 2).sum(-1).mean()
    for (part, joints), weight, scale in zip(
        body_parts(windows.skeleton, ("lower", "upper")).items(), method.diversity, method.diversity_scale, strict=True
    ):
        part_motions = motions.unflatten(-1, (-1, 3))[..., list(joints), :]
        similarities = [
            torch.exp(-(part_motions[i] - part_motions[j]).abs().sum((1, 2, 3)) / scale)
            for i in range(K)
            for j in range(i)
        ]
        assert part in ("lower", "upper")
        L += weight * torch.stack(similarities).mean()
    limits = motion.AngleLimits(model.limits, model.angle_low, model.angle_high)
    L += method.angles * energies.joint_angles(motions, limits, windows.skeleton).mean()
    L -= 1e-3 * program["x"]["fn"].by_step(x.repeat(K, 1, 1))[:, first:].sum(1).mean() / T  # fits only the scale
    torch.testing.assert_close(objective(result, 0), L, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("skeleton", "frames", "card"),
    [
        ("human36m", 125, (20, 10, 0.1, 0.2, 100, 1, 0.01, 0.5, 0.1)),
        ("humaneva", 75, (10, 5, 0.1, 0.2, 100, 1, 0.001, 0.5, 0.1)),
    ],
)
def test_the_presets_have_the_weights_of_the_paper(skeleton, frames, card):
    """The weights are (lr, lmm, l_lower, l_upper, l_limb, l_angle, l_nf, lz, lw); lw is divided by T frames."""
    objective = dvae.method("hit-dvae", warm_up=0, **PRESETS[skeleton]).objective()
    names = ("reconstruction", "multimodal", "diversity_lower", "diversity_upper", "limb", "angles", "pose_prior")
    weights = [objective.energy_weights[name] for name in names]
    assert [*weights, objective.kl_weight["z"], objective.kl_weight["w"] / frames] == pytest.approx(card)


@pytest.mark.parametrize(
    ("skeleton", "name", "batch", "steps", "frames", "observed", "scales", "weights"),
    [
        (motion.HUMAN36M, "h36m", 32, 15_625, 125, 25, (100, 300), (20, 10, 0.1, 0.2, 100, 1, 0.01, 0.5, 0.1)),
        (motion.HUMANEVA, "humaneva", 64, 7813, 75, 15, (15, 50), (10, 5, 0.1, 0.2, 100, 1, 0.001, 0.5, 0.1)),
    ],
)
def test_the_published_preset_has_the_values_of_the_paper(
    skeleton, name, batch, steps, frames, observed, scales, weights
):
    """Sections 3.1.1, 3.3, 4.1.1 and 4.2, and appendix A."""
    schema = Poses.from_data(motion.PROTOCOLS[name], skeleton)
    assert (schema.frames, schema.protocol.observed) == (frames, observed)
    method = dvae.method("hit-dvae", published=True).resolve_defaults(schema)
    training = method.training(schema)
    assert (training.batch_size, training.learning_rate, training.decay, training.optimizer) == (batch, 1e-3, 0, "adam")
    assert training.steps == steps == math.ceil(500 * 1000 / batch)
    assert method.sizes() == {"w": 32, "z": 16}
    objective = replace(method, warm_up=0).objective()
    assert objective.draws == {"w": 50}
    names = ("reconstruction", "multimodal", "diversity_lower", "diversity_upper", "limb", "angles", "pose_prior")
    values = [objective.energy_weights[name] for name in names]
    assert [*values, objective.kl_weight["z"], objective.kl_weight["w"] / frames] == pytest.approx(weights)
    assert method.diversity_scale == scales
    networks = method.networks()
    for factor, width in (("p(z)", 64), ("q(z)", 64), ("p(x)", 256)):
        network = networks[factor]
        assert (network.width, network.heads, network.feedforward or 4 * network.width) == (width, 4, 4 * width)
        assert (network.nearest, network.start, network.positions) == (False, False, "sinusoids")
        assert network.extract == {"x": NodeGraph(8, 1, 3)}
    assert networks["q(w)"] == FrameGraph(observed, 64, 4, extract={"x": NodeGraph(8, 1, 3)})
    assert method.distributions()["p(x)"] == FixedNormal()  # the identity as covariance, no residual
    model = method.build(schema)
    assert "x" not in model.units
    assert model.feeding.start == 1
    assert model.heading is None


def test_published_values_yield_to_options_and_apply_to_other_skeletons(windows):
    """Other skeletons have the values of HumanEva-I."""
    humaneva = PUBLISHED["humaneva"]
    method = dvae.method("hit-dvae", published=True).resolve_defaults(windows)
    assert {name: getattr(method, name) for name in humaneva} == humaneva
    assert method.training(windows) == method.trainings["humaneva"] != dvae.method("hit-dvae").training(windows)
    changed = dvae.method("hit-dvae", published=True, residual=0.5, nearest=True, samples=10).resolve_defaults(windows)
    assert changed == replace(method, residual=0.5, nearest=True, samples=10)
    ours = dvae.method("hit-dvae").resolve_defaults(windows)
    assert {name for name in OURS if getattr(ours, name) != getattr(method, name)} == {*OURS}


def test_the_published_model_is_fitted_and_forecasts(people, tmp_path):
    data = dvae.motion.MotionData.open(people)
    small_networks = {"width": 8, "heads_count": 2, "decoder": 8, "pose_width": 2, "samples": 3, "pose_prior": 0.0}
    method = dvae.method("hit-dvae", published=True, **small_networks)
    dvae.fit(
        method, data, out=tmp_path / "run", steps=4, validate_every=2, batch_size=2, accelerator="cpu", progress=False
    )
    run = runs.load(tmp_path / "run")
    assert run.method == method.resolve_defaults(data.windows("train"))
    past = data.windows("test").all()["x"][:2, :15]
    torch.manual_seed(0)
    forecasts = run.model.forecast(past, 80, 2)["x"]
    assert torch.isfinite(forecasts).all()
    torch.manual_seed(0)  # the unit scale weights the error: forecasts are means without a noise of a metre
    assert torch.equal(forecasts, run.model.forecast(past, 80, 2, draw_emission=False)["x"])
    assert not run.model.is_drawn()
    assert dvae.method("hit-dvae", **small_networks).build(data.windows("train")).is_drawn()  # the scale is fitted


@pytest.mark.parametrize("length", [50, 125])
def test_the_weight_of_the_static_latent_is_relative_to_the_number_of_frames(length):
    schema = Poses.from_data(motion.PROTOCOLS["h36m"], motion.HUMAN36M, length)
    for options in ({}, {"published": True}):
        method = replace(dvae.method("hit-dvae", **options).resolve_defaults(schema), warm_up=0)
        assert method.objective().kl_weight["w"] == pytest.approx(0.1 * length)
    assert dvae.method("hit-dvae", kl_static=2.0).resolve_defaults(schema).kl_static == 2.0


def test_schedules_have_the_epochs_of_the_paper(windows):
    """KL weights rise over 20 epochs, scheduled sampling over the next 80."""
    method = dvae.method("hit-dvae").resolve_defaults(windows)
    recipe = method.train(windows, steps=500)
    feeding, (stage,) = recipe.feeding, recipe.stages
    assert [feeding(epoch) for epoch in (0, 20, 60, 100, 499)] == [0, 0, 0.5, 1, 1]
    weight = stage.objective.kl_weight["z"]
    assert [weight(epoch) / method.kl_local for epoch in (0, 10, 20, 499)] == pytest.approx([0, 0.5, 1, 1])
    assert replace(method, warm_up=0).train(windows).objective.kl_weight["z"] == method.kl_local


# ------------------------------------------------------------------------------------------------------ forecasts


def test_padding_does_not_change_the_heading(windows):
    model, x = build(windows, heading=True).eval(), batch_of(windows)["x"]
    bounds = []
    for padding in (0.0, 1.0):
        ragged = x.clone()
        ragged[0, 20:] = padding * torch.randn_like(ragged[0, 20:])
        torch.manual_seed(0)
        bounds.append(dvae.SequenceELBO().terms(model, {"x": ragged, "lengths": torch.tensor([20, 75, 75])}).bound)
    torch.testing.assert_close(*bounds)
    with pytest.raises(ValueError, match="sequence"):
        model.guide({"x": x, "lengths": torch.tensor([10, 75, 75])})


# -------------------------------------------------------------------------------------------------- runs, ablations


@pytest.mark.parametrize("ablation", ["without attention and w", "evidence, turned"])
def test_an_ablation_is_fitted_and_loaded_and_forecasts(people, tmp_path, ablation):
    """The best weights are selected by the trained loss."""
    data = dvae.motion.MotionData.open(people)
    method = small(warm_up=1, **ABLATIONS[ablation])
    training = dvae.Training(steps=4, validate_every=2, batch_size=2, progress=False, accelerator="cpu")
    result = dvae.fit(method, data, out=tmp_path / "run", **vars(training))
    rows = [row for row in result.history if any(name.startswith("validation/") for name in row)]
    assert all(("validation/loss" in row) == (method.loss == "best-of-many") for row in rows)
    assert ("validation loss" in result.best) == (method.loss == "best-of-many")
    run = runs.load(tmp_path / "run")
    assert run.method == configured(run.method.config()) == replace(method.resolve_defaults(data.windows("train")))
    assert run.model.feeding.probability == 0
    past = data.windows("test").all()["x"][:2, :15]
    assert torch.isfinite(run.model.forecast(past, 3, 2)["x"]).all()
    assert ("w" in run.model.latents) == bool(method.static)


def test_without_a_skeleton_the_model_has_only_equations_and_networks():
    model = dvae.method("hit-dvae").build({"x": 12})
    assert not isinstance(model, HiTModel)
    assert math.isfinite(dvae.SequenceELBO().loss(model, model.guide, torch.randn(2, 4, 12)))
