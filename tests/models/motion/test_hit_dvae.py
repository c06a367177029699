"""HiT-DVAE whole: what depends on what in the built model, the paper's objective, forecasts, ablations."""

import math
from dataclasses import replace

import pytest
import torch
from pyro import poutine

import dvae
from dvae import motion
from dvae.models.motion.hit_dvae import PRESETS, HiTModel
from dvae.models.registry import configured
from dvae.motion.geometry.parts import body_parts
from dvae.motion.scoring import energies
from dvae.networks.graphs import NodeFeatures
from dvae.runs import directory as runs

SMALL = {"latent": 3, "static": 2, "width": 8, "heads_count": 2, "decoder": 8, "pose_width": 2, "samples": 3}
QUICK = {**SMALL, "pose_prior": 0.0, "angles": 0.0, "multimodal": 0.0, "heading": False}
ABLATIONS = {
    "whole": {},
    "without scheduled sampling": {"self_feeding": 0.0},
    "without attention": {"attention": False},
    "without w": {"static": 0},
    "without attention and w": {"attention": False, "static": 0},
    "with its past": {"guide_past": True},
    "queries as in the paper": {"nearest": False},
    "attention-pooled": {"summary": "attention"},
    "poses as they are": {"pose_width": 0},
    "evidence": {"loss": "evidence"},
    "evidence, turned": {"loss": "evidence", "heading": True},
}
ENERGIES = {"samples": None, "pose_prior": None, "angles": None, "multimodal": None}


def build(windows, **options):
    torch.manual_seed(0)
    return small(**options).suited(windows).build(windows).double()


def small(**options):
    """The method at test size; options of best-of-many alone are left open beside the evidence."""
    return dvae.method("hit-dvae", **{**QUICK, **(ENERGIES if options.get("loss") == "evidence" else {}), **options})


def drawn(windows, size=3, **options):
    method = small(**options)
    batch = method.train(windows).batches.sample(size, torch.Generator().manual_seed(0))
    return {name: v.double() if v.is_floating_point() else v for name, v in batch.items()}


def terms(model, batch, **program):
    objective = model.method.objective()
    return dvae.SequenceELBO().terms(model, batch, draws=objective.draws, **program), objective


# ------------------------------------------------------------------------------------------ what depends on what


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_the_built_model_leaks_nothing_from_the_present_or_the_future(windows, ablation):
    """By the program itself: x_t moves no p(x_s | .) and no p(z_s | .) with s <= t, z_t no p(z_s | .) with s <= t.

    With one exception: where windows are turned by a frame, here the last, what that one tells of its heading is known
    everywhere. So it is moved in a way that turns nobody, all joints alike.
    """
    model, steps = build(windows, **ABLATIONS[ablation]).eval(), 6
    turned = isinstance(model, HiTModel) and model.method.heading
    x = drawn(windows)["x"][:1, :steps]
    latents = model.guide(x)

    def means(x, z):
        sites = poutine.trace(poutine.condition(model.model, data={**latents, "z": z})).get_trace(x).nodes
        return [sites[name]["fn"].steps(sites[name]["value"]) for name in ("x", "z")]

    def moved(x, z):
        before, after = means(x0, z0), means(x, z)
        apart = [
            (a.loc - b.loc).abs().amax((0, 2)) + (a.scale - b.scale).abs().amax((0, 2))
            for a, b in zip(before, after, strict=True)
        ]
        return [values.gt(0).tolist() for values in apart]

    x0, z0 = x, latents["z"]
    for t in range(steps):
        x, z = x0.clone(), z0.clone()
        x[:, t] += 0.1 * (1 if turned and t == steps - 1 else torch.randn_like(x[:, t]))
        z[:, t] += 0.1 * torch.randn_like(z[:, t])
        of_x, of_z = moved(x, z0)
        assert of_x == [s > t for s in range(steps)]
        assert of_z == [s == t + 1 for s in range(steps)]
        of_x, of_z = moved(x0, z)
        assert of_x == [s == t for s in range(steps)]
        assert of_z == [s > t for s in range(steps)]


def test_the_equations_are_the_papers_and_those_of_its_ablations():
    def texts(**options):
        return tuple(equation.text for equation in dvae.method("hit-dvae", **options).equations())

    p, q = "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"
    assert texts() == (p, q)
    assert texts(guide_past=True) == (p, "q(w | x_{1:T}) q(z_t | z_{<t}, x_{1:T}, w)")
    assert texts(static=0) == ("p(z_t | z_{<t}, x_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | x_{1:T})")


def test_factors_share_the_features_of_poses_on_each_side(windows):
    model = build(windows)
    ours, theirs = (
        {id(c.network.extractors["x"]) for c in side.values() if c.network is not None}
        for side in (model.generator, model.encoder)
    )
    assert len(ours) == len(theirs) == 1
    assert ours != theirs


# -------------------------------------------------------------------------------------------------- the objective


def test_the_loss_is_the_papers(windows):
    """L of the card from its terms, with means over time and sums over coordinates, for one window after the other."""
    options = {"angles": 2.0, "multimodal": 3.0, "heading": True, "warm_up": 0, "pseudo_minimum": 0.0}
    model, batch = build(windows, **options).eval(), drawn(windows, **options)
    assert batch["valid"].any()
    found, objective = terms(model, batch)
    latents = poutine.trace(model.guide).get_trace
    torch.manual_seed(1)
    sites = latents(batch, draws=objective.draws).nodes
    torch.manual_seed(1)
    found, _ = terms(model, batch)
    K, B, T = 3, 3, 75
    z, w = (sites[name]["value"] for name in ("z", "w"))
    x, pseudo = (model.turned(batch[name]) for name in ("x", "pseudo"))
    again = {"x": batch["x"].repeat(K, 1, 1)}
    program = poutine.trace(poutine.condition(model.model, data={"z": z, "w": w})).get_trace(again).nodes
    motions = program["x"]["fn"].steps(x.repeat(K, 1, 1)).loc.unflatten(0, (K, B))

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
    L += method.kl_local * kl("z").sum(-1).mean(-1).mean() + method.kl_static / T * kl("w").sum(-1).mean()
    lengths, own = (windows.skeleton.bone_lengths(windows.positions(v)) for v in (motions, x[:, :1]))
    L += method.limb * ((lengths - own) ** 2).sum(-1).mean()
    for (part, joints), weight, scale in zip(
        body_parts(windows.skeleton, ("lower", "upper")).items(), method.diversity, method.diversity_scale, strict=True
    ):
        held = motions.unflatten(-1, (-1, 3))[..., list(joints), :]
        likeness = [torch.exp(-(held[i] - held[j]).abs().sum((1, 2, 3)) / scale) for i in range(K) for j in range(i)]
        assert part in ("lower", "upper")
        L += weight * torch.stack(likeness).mean()
    limits = motion.AngleLimits(model.limits, model.angle_low, model.angle_high)
    L += method.angles * energies.joint_angles(motions, limits, windows.skeleton).mean()
    L -= 1e-3 * program["x"]["fn"].log_prob(x.repeat(K, 1, 1)).mean() / T  # which fits the scale alone
    torch.testing.assert_close(objective(found, 0), L, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("heading", [False, True])
def test_bones_keep_the_lengths_that_were_seen_and_energies_are_of_positions(windows, heading):
    options = {"bones": True, "heading": heading}
    model, batch = build(windows, **options).eval(), drawn(windows, **options)
    past, skeleton = batch["x"][:, :15], windows.skeleton

    def lengths(x):
        return skeleton.bone_lengths(windows.positions(x))

    future = model.forecast(past, 20, 2)["x"]
    torch.testing.assert_close(lengths(future), lengths(past).mean(1)[:, None].expand(2, -1, 20, -1))
    whole = model.reconstruct(batch["x"])["x"]
    torch.testing.assert_close(lengths(whole), lengths(past).mean(1)[:, None].expand(1, -1, 75, -1))
    objective = model.method.objective()
    torch.manual_seed(1)
    latents = poutine.trace(model.guide).get_trace(batch, draws=objective.draws).nodes
    torch.manual_seed(1)
    found, _ = terms(model, batch)
    held = {name: latents[name]["value"] for name in ("z", "w")}
    again = {"x": batch["x"].repeat(3, 1, 1)}
    rollout = poutine.trace(poutine.condition(model.model, data=held)).get_trace(again).nodes["x"]["infer"]["run"]
    made = rollout.parameters("x", rollout.values["x"])[0].unflatten(0, (3, 3))
    assert made.unflatten(-1, (-1, 3)).norm(dim=-1).sub(1).abs().max() < 1e-9
    limbs = made.unflatten(-1, (-1, 3)) * lengths(past).mean(1)[:, None, :, None]
    expected = energies.best_of_many(skeleton.ends(limbs), model.turned(batch["x"]))
    torch.testing.assert_close(found.energies["reconstruction"], expected, rtol=1e-5, atol=1e-5)
    assert found.energies["limb"].max() < 1e-8


def test_directions_of_bones_leave_no_bound(windows):
    model, batch = build(windows, bones=True), drawn(windows)
    found, objective = terms(model, batch, self_feeding=1.0)
    assert not found.likelihood
    objective(found, 10**6).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.parameters() if p.requires_grad)
    with pytest.raises(ValueError, match="has no likelihood"):
        dvae.importance_bound(model, batch["x"], particles=2)
    with pytest.raises(ValueError, match="loss='evidence' has no bones"):
        dvae.method("hit-dvae", loss="evidence", bones=True)
    with pytest.raises(ValueError, match="directions of bones, of which both ends have to be there"):
        model.guide({"x": batch["x"], "mask": torch.rand_like(batch["x"]) < 0.5})
    with pytest.raises(dvae.data.schema.SchemaError, match="hit-dvae"):
        dvae.method("hit-dvae", bones=True).build({"x": 48})


def test_the_density_fits_the_scale_and_energies_the_poses(windows):
    model, batch = build(windows), drawn(windows)
    found, objective = terms(model, batch, self_feeding=1.0)
    x = model.generator["x"]
    likelihood = torch.autograd.grad(
        found.log_likelihood["x"].sum(), list(x.parameters()), retain_graph=True, allow_unused=True
    )
    reached = {
        name
        for (name, _), g in zip(x.named_parameters(), likelihood, strict=True)
        if g is not None and g.abs().sum() > 0
    }
    assert reached == {"law.log_scale"}
    objective(found, 10**6).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.parameters() if p.requires_grad)


def test_the_bound_is_that_of_one_draw_unless_several_are_asked_for(windows):
    model, batch = build(windows).eval(), drawn(windows)
    alone = dvae.SequenceELBO().terms(model, batch)
    assert not alone.energies
    assert torch.isfinite(dvae.importance_bound(model, batch["x"], particles=3).bound).all()
    assert set(terms(model, batch)[0].energies) == {"reconstruction", "limb", "diversity_lower", "diversity_upper"}


@pytest.mark.parametrize("skeleton", ["human36m", "humaneva"])
def test_the_presets_are_the_papers_weights(skeleton):
    """(lr, lmm, l_lower, l_upper, l_limb, l_angle, l_nf, lz, lw) of the card, lw beside means over T frames."""
    objective = dvae.method("hit-dvae", warm_up=0, **PRESETS[skeleton]).objective()
    frames = {"human36m": 125, "humaneva": 75}[skeleton]
    names = ("reconstruction", "multimodal", "diversity_lower", "diversity_upper", "limb", "angles", "pose_prior")
    card = {
        "human36m": (20, 10, 0.1, 0.2, 100, 1, 0.01, 0.5, 0.1),
        "humaneva": (10, 5, 0.1, 0.2, 100, 1, 0.001, 0.5, 0.1),
    }
    weights = [objective.energy_weights[name] for name in names] + [
        objective.kl_weight["z"],
        objective.kl_weight["w"] / frames,
    ]
    assert weights == pytest.approx(card[skeleton])


def test_schedules_have_the_papers_shares_of_500_epochs(windows):
    """KL weights rise over 20 epochs, self-feeding over the next 80."""
    method = dvae.method("hit-dvae").suited(windows)
    recipe = method.train(windows, steps=500)
    feeding, (stage,) = recipe.feeding, recipe.stages
    assert [feeding(epoch) for epoch in (0, 20, 60, 100, 499)] == [0, 0, 0.5, 1, 1]
    weight = stage.objective.kl_weight["z"]
    assert [weight(epoch) / method.kl_local for epoch in (0, 10, 20, 499)] == pytest.approx([0, 0.5, 1, 1])
    assert replace(method, warm_up=0).train(windows).objective.kl_weight["z"] == method.kl_local


def test_options_reach_the_model(windows):
    feeding = {"feeding_passes": 2, "feeding_gradient": True, "frames": 5}
    assert build(windows, **feeding).feeding == dvae.SelfFeeding(0.0, 2, True, 15)
    assert build(windows, feed_observed=True).feeding == dvae.SelfFeeding(0.0, gradient=False)
    assert build(windows, loss="evidence", frames=5, **{"feeding_passes": 3}).feeding == dvae.SelfFeeding(
        0.0, 3, gradient=False, start=15
    )
    assert "x" in build(windows).units
    assert not build(windows, standardise=False).units
    assert build(windows, frames=5).encoder["w"].network.frames == 5


def test_a_prepared_model_starts_at_the_spread_of_poses(windows):
    method = small().suited(windows)
    model = method.build(windows)
    method.train(windows).prepare(model)
    x = windows.all()["x"][:2]
    scale = poutine.trace(model.model).get_trace(x).nodes["x"]["fn"].steps(x).scale
    assert scale.mean().item() == pytest.approx(windows.poses().var(0).mean().sqrt().item(), rel=0.05)


def test_all_draws_of_a_window_sum_up_the_same_frames(windows):
    """In training a window starts anywhere, anew for every sequence, but not for every draw."""
    model = build(windows).train()
    law = poutine.trace(model.guide).get_trace(drawn(windows), draws={"w": 4}).nodes["w"]["fn"]
    loc = law.base_dist.loc.unflatten(0, (4, 3))
    assert (loc == loc[:1]).all()
    again = poutine.trace(model.guide).get_trace(drawn(windows), draws={"w": 4}).nodes["w"]["fn"]
    assert not torch.equal(law.base_dist.loc, again.base_dist.loc)


# ------------------------------------------------------------------------------------------------------ forecasts


@pytest.mark.parametrize("heading", [False, True])
@pytest.mark.parametrize(("observed", "horizon"), [(15, 60), (4, 3), (30, 100)])
def test_any_past_is_continued_over_any_horizon(windows, observed, horizon, heading):
    model = build(windows, heading=heading)
    past = drawn(windows)["x"][:, :observed]
    futures = model.forecast(past, horizon, 2)
    assert futures["x"].shape == (2, 3, horizon, windows.size)
    assert futures["z"].shape == (2, 3, observed + horizon, 3)
    assert torch.isfinite(futures["x"]).all()


def test_a_forecast_finds_features_of_a_frame_once(windows, monkeypatch):
    """For both factors, and of what was observed for all samples, whose draws are those of as many sequences."""
    model, past, shapes = build(windows).eval(), drawn(windows)["x"][:, :5], []
    hoisted = NodeFeatures.hoisted

    def counted(self):
        features = hoisted(self)
        return lambda frames: shapes.append(tuple(frames.shape[:-1])) or features(frames)

    monkeypatch.setattr(NodeFeatures, "hoisted", counted)
    torch.manual_seed(0)
    futures = model.forecast(past, 4, 6)
    assert shapes == [(3, 5), (3, 5), *[(18,)] * 3]  # the guide, the past, and all but the last frame
    torch.manual_seed(0)
    with torch.no_grad():
        latents = {name: value.unflatten(0, (6, 3)) for name, value in model.guide(past.repeat(6, 1, 1)).items()}
    torch.testing.assert_close({"w": futures["w"], "z": futures["z"][:, :, :5]}, latents)


def test_turning_people_turns_their_futures_and_changes_no_score(windows):
    model, batch = build(windows, heading=True).eval(), drawn(windows)

    def turn(x):
        joints = motion.rotate_about_up(x.unflatten(-1, (-1, 3)), torch.tensor(1.3, dtype=x.dtype), windows.skeleton.up)
        return joints.flatten(-2)

    found = []
    for x in (batch["x"], turn(batch["x"])):
        torch.manual_seed(0)
        future, rebuilt = model.forecast(x[:, :15], 5, 2)["x"], model.reconstruct(x)["x"]
        torch.manual_seed(0)
        found.append((future, rebuilt, terms(model, {"x": x})[0]))
    (future, rebuilt, score), (other, another, same) = found
    torch.testing.assert_close(other, turn(future), rtol=0, atol=1e-9)
    torch.testing.assert_close(another, turn(rebuilt), rtol=0, atol=1e-9)
    torch.testing.assert_close(same.bound, score.bound, rtol=1e-9, atol=0)
    for name, energy in score.energies.items():
        torch.testing.assert_close(same.energies[name], energy, rtol=1e-8, atol=1e-8)


def test_energies_are_of_windows_of_one_length(windows):
    x, lengths = drawn(windows)["x"], torch.tensor([20, 75, 75])
    model = build(windows)
    with pytest.raises(ValueError, match="leave 'lengths' out"):
        terms(model, {"x": x, "lengths": lengths})
    assert torch.isfinite(dvae.SequenceELBO().terms(model, {"x": x, "lengths": lengths}).bound).all()


def test_what_lies_beyond_a_sequence_turns_nobody(windows):
    model, x = build(windows, heading=True).eval(), drawn(windows)["x"]
    bounds = []
    for padding in (0.0, 1.0):
        ragged = x.clone()
        ragged[0, 20:] = padding * torch.randn_like(ragged[0, 20:])
        torch.manual_seed(0)
        bounds.append(dvae.SequenceELBO().terms(model, {"x": ragged, "lengths": torch.tensor([20, 75, 75])}).bound)
    torch.testing.assert_close(*bounds)
    with pytest.raises(ValueError, match="turns every window by its frame 15, but a sequence has 10"):
        model.guide({"x": x, "lengths": torch.tensor([10, 75, 75])})


def test_missing_joints_stay_missing_where_windows_are_turned(windows):
    model, x = build(windows, heading=True).eval(), drawn(windows)["x"]
    mask = torch.ones_like(x, dtype=torch.bool)
    mask[:, 20:30, 3:9] = False
    bounds = []
    for hidden in (0.0, torch.nan):
        torch.manual_seed(0)
        bounds.append(dvae.SequenceELBO().terms(model, {"x": torch.where(mask, x, hidden), "mask": mask}).bound)
    assert torch.equal(*bounds)


# -------------------------------------------------------------------------------------------------- runs, ablations


@pytest.mark.parametrize("ablation", ["whole", "without attention and w", "evidence, turned"])
def test_an_ablation_is_fitted_loaded_and_forecasts(people, tmp_path, ablation):
    """And the best weights are by what is trained."""
    data = dvae.motion.MotionData.open(people)
    method = small(warm_up=1, **ABLATIONS[ablation])
    training = dvae.Training(steps=4, validate_every=2, batch_size=2, progress=False, accelerator="cpu")
    result = runs.fit_run(method, data, tmp_path / "run", training)
    rows = [row for row in result.history if any(name.startswith("validation/") for name in row)]
    assert all(("validation/loss" in row) == (method.loss == "best-of-many") for row in rows)
    assert ("validation loss" in result.best) == (method.loss == "best-of-many")
    loaded = runs.load(tmp_path / "run")
    assert loaded.method == replace(method.suited(data.windows("train")))
    assert configured(loaded.method.config()) == loaded.method
    assert loaded.model.feeding.probability == 0
    past = data.windows("test").all()["x"][:2, :15]
    assert torch.isfinite(loaded.model.forecast(past, 3, 2)["x"]).all()
    assert ("w" in loaded.model.latents) == bool(method.static)


def test_without_a_skeleton_there_are_the_equations_and_their_networks():
    model = dvae.method("hit-dvae").build({"x": 12})
    assert not isinstance(model, HiTModel)
    assert math.isfinite(dvae.SequenceELBO().loss(model, model.guide, torch.randn(2, 4, 12)))


@pytest.mark.parametrize("loss", ["best-of-many", "evidence"])
def test_only_poses_go_through_pose_graphs(windows, loss):
    def graphs(model):
        return any(isinstance(module, NodeFeatures) for module in model.modules())

    method = dvae.method("hit-dvae", loss=loss)
    assert not graphs(method.build({"x": windows.size}))  # numbers that nobody called joints
    assert graphs(method.build(windows))
    assert method.suited(windows).pose_width == 8
    assert graphs(replace(method, pose_width=2).build({"x": 12}))
    assert not graphs(replace(method, pose_width=0).build(windows))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"loss": "elbo"}, "unknown loss 'elbo'; known: best-of-many, evidence"),
        ({"summary": "mean"}, "unknown summary 'mean'; known: graph, attention"),
        ({"samples": 1}, "samples is 1; it must be at least 2"),
        ({"emission": "student"}, "emission='student' needs loss='evidence'"),
        ({"diversity": (1.0,)}, "diversity is .*; expected one number for each of lower, upper"),
        ({"kl_static": -1.0}, "kl_static is -1.0; it must be finite and at least 0"),
        ({"frames": 0}, "frames is 0; it must be at least 1"),
        ({"loss": "evidence", "kl_local": 9.0, "samples": 7}, "loss='evidence' has no kl_local, samples"),
    ],
)
def test_options_that_cannot_be(options, message):
    with pytest.raises(ValueError, match=message):
        dvae.method("hit-dvae", **options)


def test_weights_are_asked_for_where_they_are_known(windows):
    with pytest.raises(ValueError, match=r"take those of method.suited\(windows\)"):
        dvae.method("hit-dvae").objective()
    rooted = motion.windows(motion.simulate(clips=4), replace(windows.protocol, root="relative"), "train")
    with pytest.raises(ValueError, match="use one with root='drop'"):
        dvae.method("hit-dvae").build(rooted)
    assert dvae.method("hit-dvae", loss="evidence").build(rooted).sizes["x"] == 51
