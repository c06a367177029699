"""Completion: what a decoder made is found again from part of it, at known and unknown times, and how surely."""

import pytest
import torch
from pyro import poutine

import dvae
from dvae import motion
from dvae.models.motion.motion_latent import MotionLatent
from dvae.motion import bodies
from dvae.motion.segments.completion import (
    Deviations,
    SegmentCompletion,
    _at_moments,
    _shrink,
    chamfer,
    complete,
    error_by_time,
    nearest_vertices,
    sample_surfaces,
    simulate_observations,
    surfaces_at,
)
from dvae.motion.segments.embodied import SHAPE, Segments
from dvae.motion.segments.recovery import recover

BRIEF = dvae.Descent(steps=80, rate=0.1, starts=1, candidates=4)
THOROUGH = dvae.Descent(steps=80, rate=0.1, starts=2, candidates=8, newton=3)


@pytest.fixture(scope="module")
def segments():
    people = bodies.fit_to_body(motion.simulate(clips=4, frames=90, seed=1), bodies.human())
    return Segments(motion.gait_cycles(people))


@pytest.fixture(scope="module")
def model(segments):
    """Nearly linear in z about a typical segment, with turns of some tenths: its hidden units are seldom off."""
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        model = MotionLatent(latent=3, widths=(16,)).build(segments).eval().double()
        trunk = model.generator["rotations"].network.trunk
        waves = torch.stack([torch.cos(torch.pi * n * torch.linspace(0, 1, 100)) for n in range(4)], 1).double()
        drawn = torch.randn(4, 16, model.timed.size, dtype=torch.float64)
        trunk.out.weight.copy_(0.05 * torch.einsum("tn,nhd->tdh", waves, drawn).flatten(0, 1))
        trunk.hidden[0].bias.fill_(2.0)
        trunk.out.bias.copy_(segments.all()["x"][0].flatten() - trunk.out.weight.sum(-1) * 2)
    return model


def made(model, many, seed=0):
    """Segments that a model makes: z, beta and x."""
    generator = torch.Generator().manual_seed(seed)
    z = torch.randn(many, 3, generator=generator, dtype=torch.float64)
    shape = torch.randn(many, 8, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        return z, shape, model.decode(z, shape)


def test_decoding_is_the_mean_of_the_program(model):
    z, shape, x = made(model, 3)
    program = poutine.condition(model.model, data={"z": z})
    parts = program({SHAPE: shape}, length=100, mean_emission=True)
    torch.testing.assert_close(model.to_data_space(parts)["x"], x)
    torch.testing.assert_close(model.decode(z[:, None], shape[:, None]), x[:, None])
    some = torch.tensor([0, 40, 99])
    torch.testing.assert_close(model.decode(z, shape, some), x[:, some])


def test_moments_are_met_in_decoded_time(model):
    x = made(model, 2)[2].requires_grad_()
    times = model.timed.times(x)
    for frame in (0, 40, 99):
        met, reached = _at_moments(model.timed, x, {"times": times[:, [frame]].detach()})
        torch.testing.assert_close(met, x[:, [frame]])
        torch.testing.assert_close(reached, times[:, [frame]])
    between = (times[:, [3]] + 2 * times[:, [4]]) / 3
    torch.testing.assert_close(
        _at_moments(model.timed, x, {"times": between.detach()})[0], (x[:, [3]] + 2 * x[:, [4]]) / 3
    )
    located = _at_moments(model.timed, x, {"frames": torch.full((2, 1), 3 + 2 / 3).double()})
    torch.testing.assert_close(located[0], (x[:, [3]] + 2 * x[:, [4]]) / 3)
    torch.testing.assert_close(located[1], between)
    after, reached = _at_moments(model.timed, x, {"times": times[:, [-1]].detach() + 0.5})
    torch.testing.assert_close(after, x[:, [-1]])
    torch.testing.assert_close(reached, times[:, [-1]])
    # the later all frames are, the earlier is the one that is met
    gradient = torch.autograd.grad(_at_moments(model.timed, x, {"times": between.detach()})[0].sum(), x)[0]
    assert gradient[..., 1:5, -1].abs().min() > 0


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("surfaces", {"frames": range(0, 100, 25)}),
        ("markers", {"fps": 10.0, "gaps": 0.2}),
        ("points", {"frames": range(0, 100, 20)}),
    ],
)
def test_what_the_decoder_made_is_found_again(model, kind, options):
    """A mode is no less probable than the truth; of points, which do not tell how they belong, it is as near."""
    z, shape, x = made(model, 2)
    seen = simulate_observations(model, x, shape, kind, **options)
    found = complete(model, seen, descent=THOROUGH)
    if kind == "points":
        ours, theirs = (
            model.vertices(*each)[:, seen["frames"][0].long()] for each in ((found.x, found.shape), (x, shape))
        )
        assert chamfer(seen["points"], ours).mean() < 1.5 * chamfer(seen["points"], theirs).mean()
    else:
        truth = poutine.condition(SegmentCompletion(model), data={"z": z, SHAPE: shape})
        trace = poutine.trace(truth).get_trace(found.seen)
        assert found.posterior.energy.sum() <= -trace.log_prob_sum()
        error = bodies.vertex_error(model.vertices(found.x, found.shape), model.vertices(x, shape))
        assert error.max() < 0.02
        assert found.posterior.left.max() < 0.01
    known = complete(model, {**seen, SHAPE: shape}, descent=BRIEF)
    assert torch.equal(known.shape, shape)
    assert set(known.posterior.mode) == {"z"}
    drawn = found.draw(5)
    assert drawn[0].shape == (5, *x.shape)
    assert drawn[1].shape == (5, *shape.shape)


def test_intervals_of_completions_hold_what_they_promise(model):
    """Of segments from the model and markers with its noise, within four binomial standard errors."""
    z, shape, x = made(model, 120, seed=3)
    noise = Deviations(marker=0.05)
    seen = simulate_observations(model, x, shape, "markers", frames=[10, 60])
    seen["markers"] = seen["markers"] + noise.marker * torch.randn_like(seen["markers"])
    found = complete(model, {**seen, SHAPE: shape}, deviations=noise, descent=BRIEF)
    away = ((z - found.posterior.mode["z"]) / found.posterior.deviation["z"]).abs()
    for level in (0.5, 0.8, 0.9):
        reach = torch.distributions.Normal(0.0, 1.0).icdf(torch.tensor((1 + level) / 2))
        error = (level * (1 - level) / z.numel()) ** 0.5
        assert abs((away < reach).double().mean() - level) < 4 * error
        assert abs((away < reach / 2).double().mean() - level) > 4 * error


def test_what_is_missing_counts_for_nothing(model):
    z, shape, x = made(model, 2)
    program = SegmentCompletion(model)
    seen = simulate_observations(model, x, shape, "markers", frames=[5, 50, 80])

    def energy(seen):
        conditioned = poutine.condition(program, data={"z": z + 0.1, SHAPE: shape})
        return poutine.trace(conditioned).get_trace(program.read(seen)).log_prob_sum()

    cut = {name: value[:, :2] for name, value in seen.items()}
    lost = {name: value.clone() for name, value in seen.items()}
    for value in lost.values():
        value[:, 2] = torch.nan
    torch.testing.assert_close(energy(lost), energy(cut))
    assert energy(cut) != energy(seen)
    timed = {**seen, "times": model.timed.times(x)[:, [5, 50, 80]]}
    late = {**timed, "times": timed["times"] + 0.1}
    assert energy(late) < energy(timed)


def test_the_nearest_vertices_are_what_points_are_held_against(model):
    _, shape, x = made(model, 2)
    rotations, places = model.timed.poses(x[:, ::30])
    vertices = model.body(shape, rotations, places)[0]
    points = vertices[:, :, ::100] + 0.01 * torch.randn(2, 4, 15, 3, dtype=torch.float64)
    which = nearest_vertices(model.body, shape, rotations, places, points)
    assert torch.equal(which, torch.cdist(points, vertices).argmin(-1))
    program, (z, shape, x) = SegmentCompletion(model), made(model, 2)
    seen = program.read(simulate_observations(model, x, shape, "points", frames=[0, 50]))
    values = {"z": z, SHAPE: shape}
    runs = [poutine.trace(poutine.condition(program, values)) for _ in range(2)]
    batches = seen, program.renewed(seen, values)
    alone, told = (run.get_trace(batch).log_prob_sum() for run, batch in zip(runs, batches, strict=True))
    torch.testing.assert_close(alone, told)


def test_known_segments_make_the_prior(model, segments):
    """Where nothing is told of z, it is found in their middle, as wide as they are; without them, in the model's."""
    batch = {name: value.double() for name, value in segments.all().items()}
    distribution = model.posterior(batch)
    z, shape, x = made(model, 2)
    seen = {**simulate_observations(model, x, shape, "markers", frames=[0]), SHAPE: shape}
    how = {"deviations": Deviations(marker=1e6, time=1e6), "descent": BRIEF}
    ours, theirs = (complete(model, seen, known=batch, aggregate=each, **how).posterior for each in (True, False))
    wide = _shrink(distribution.mean, distribution.variance.mean(0)).diagonal()
    torch.testing.assert_close(ours.mode["z"], distribution.mean.mean(0).expand(2, -1))
    torch.testing.assert_close(ours.deviation["z"], wide.sqrt().expand(2, -1))
    torch.testing.assert_close(theirs.mode["z"], torch.zeros_like(z))
    torch.testing.assert_close(theirs.deviation["z"], torch.ones_like(z))


def test_a_covariance_of_few_is_shrink():
    """Of 50 with the covariance diag(3, 1), by hand: the share is 4^2 / (50 (10 - 4^2 / 2)) = .16, towards 2."""
    by_hand = _shrink(torch.zeros(50, 2), torch.tensor([3.0, 1.0]))
    torch.testing.assert_close(by_hand, torch.tensor([2.84, 1.16]).diag())
    root = torch.randn(6, 6).double() * torch.tensor([2.0, 1, 1, 0.5, 0.5, 0.1])
    truth, none = root @ root.mT, torch.zeros(6).double()
    assert torch.linalg.eigvalsh(_shrink(torch.randn(5, 6).double() @ root.mT, none))[0] > 1e-3
    many = torch.randn(200_000, 6).double() @ root.mT
    torch.testing.assert_close(_shrink(many, none), truth, rtol=0, atol=0.02 * float(truth.trace()))
    torch.testing.assert_close(_shrink(many[:1], none + 3), 3 * torch.eye(6).double())


def test_scans_are_uniform_and_errors_are_of_the_time_asked_for(model):
    _, shape, x = made(model, 3)
    vertices = model.vertices(x[:, :1].expand(-1, 100, -1), shape)[:, :2]
    points = sample_surfaces(vertices, model.body.faces, 4000, torch.Generator().manual_seed(0))
    assert chamfer(points, vertices).max() < 0.02
    assert chamfer(torch.where(torch.rand(*points.shape[:-1], 1) < 0.5, points, torch.nan), vertices).isfinite().all()
    # shares of points are shares of area: above the pelvis and below
    first, second, third = (vertices[0, 0][model.body.faces[:, n]] for n in range(3))
    area = (second - first).cross(third - first, dim=-1).norm(dim=-1)
    share = float(area[(first + second + third)[:, 1] / 3 > 0].sum() / area.sum())
    error = (share * (1 - share) / 4000) ** 0.5
    assert abs(float((points[0, 0, :, 1] > 0).double().mean()) - share) < 4 * error + 0.02  # of triangles across

    longest, moved = float(model.timed.lasts(x).max()), x.clone()
    moved[..., model.timed.parts["translation"][1]] += 0.1 / model.timed.metres
    errors, many = error_by_time(model, (moved, shape), (x, shape), [0.0, 0.1, longest, longest + 1])
    assert many.tolist() == [3, 3, 1, 0]
    torch.testing.assert_close(errors[:2], torch.full((2,), 0.1, dtype=torch.float64))
    assert errors[3].isnan()
    at = surfaces_at(model, x, shape, model.timed.times(x)[:, [20]])
    torch.testing.assert_close(at, model.vertices(x, shape)[:, [20]])


def test_recovered_segments_are_compared_with_the_truth_and_become_motion(model):
    _, shape, x = made(model, 2)
    seen = simulate_observations(model, x, shape, "markers", frames=range(0, 100, 20))
    keys, truth = [("a", "first"), ("b", "second")], {"x": x, SHAPE: shape}
    found = recover(model, {**seen, SHAPE: shape}, keys, truth=truth, descent=THOROUGH)
    assert found.away["markers"].max() < 1e-3
    assert found.errors["vertex error"].max() < 2e-3
    lasts = model.timed.lasts(found.found.x)
    torch.testing.assert_close(found.errors["duration error"], (lasts - model.timed.lasts(x)).abs())
    moving, true = found.motion(draws=2), found.true_motion()
    assert [clip.key for clip in moving][::3] == [("a", "first-found"), ("b", "second-found")]
    assert [clip.key for clip in true] == keys
    for clip, theirs, seconds in zip(moving.clips[::3], true, lasts.tolist(), strict=True):
        assert 0 <= seconds - (clip.frames - 1) / moving.skeleton.fps < 1 / moving.skeleton.fps + 1e-3
        shorter = min(clip.frames, theirs.frames)
        assert abs(clip.positions[:shorter] - theirs.positions[:shorter]).max() < 0.02
    for table in found.table().renderables:
        assert [str(cell) for cell in table.columns[0].cells] == ["a/first", "b/second"]
    with pytest.raises(ValueError, match="segment 1 of 2, counted from 0, has no observations"):
        recover(model, {**seen, "markers": seen["markers"] * torch.tensor([1.0, torch.nan])[:, None, None, None]}, keys)


def test_what_cannot_have_been_seen_is_refused(model):
    _, shape, x = made(model, 2)
    seen = simulate_observations(model, x, shape, "markers", frames=[0, 50])
    program = SegmentCompletion(model)
    for wrong, message in (
        ({**seen, "marker": seen["markers"]}, "unknown observations marker"),
        ({"frames": seen["frames"]}, "expected observations surfaces, points or markers"),
        ({"markers": seen["markers"]}, "with their moments"),
        ({**seen, "markers": seen["markers"][:, :, :5]}, r"markers has shape \(2, 2, 5, 3\), expected \(2, 2, 16, 3\)"),
        ({**seen, "frames": seen["frames"] + 60}, "from 0 to 99, got 60 to 110"),
        ({**seen, SHAPE: shape * torch.nan}, "beta must be given for all segments"),
    ):
        with pytest.raises(ValueError, match=message):
            program.read(wrong)
    with pytest.raises(ValueError, match="expected 'surfaces', 'points' or 'markers'"):
        simulate_observations(model, x, shape, "marker")
    with pytest.raises(ValueError, match="marker"):
        Deviations(marker=0.0)


def test_markers_are_where_their_names_say():
    body = bodies.human()
    vertices, joints = body.at_rest(torch.zeros(8))
    for name, vertex in bodies.MARKERS.items():
        side, _, part = name.rpartition("_")
        if side == "L":
            mirrored = vertices[bodies.MARKERS[f"R_{part}"]] * torch.tensor([-1.0, 1, 1])
            torch.testing.assert_close(vertices[vertex], mirrored)
        joint = {"heel": "Ankle", "toes": "Foot"}.get(part, part.title())
        if side:
            assert (vertices[vertex] - joints[body.names.index(f"{side}_{joint}")]).norm() < 0.1
    assert len(set(bodies.MARKERS.values())) == 16
