"""Completion: segments are recovered from partial observations at known and unknown times, with intervals."""

import pytest
import torch
from pyro import poutine

import dvae
from dvae import motion
from dvae.models.motion.motion_latent import MotionLatent
from dvae.motion import bodies
from dvae.motion.segments.completion import (
    THIN,
    TO_POINTS,
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
    """Return a model that is nearly linear in z about a typical segment, with rotations of some tenths."""
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        model = MotionLatent(latent=3, widths=(16,)).build(segments).eval().double()
        trunk = model.generator["rotations"].network.trunk
        waves = torch.stack([torch.cos(torch.pi * n * torch.linspace(0, 1, 100)) for n in range(4)], 1).double()
        samples = torch.randn(4, 16, model.timed.size, dtype=torch.float64)
        trunk.out.weight.copy_(0.05 * torch.einsum("tn,nhd->tdh", waves, samples).flatten(0, 1))
        trunk.hidden[0].bias.fill_(2.0)
        trunk.out.bias.copy_(segments.all()["x"][0].flatten() - trunk.out.weight.sum(-1) * 2)
    return model


def draw_segments(model, many, seed=0):
    """Return segments that a model draws: z, beta and x."""
    generator = torch.Generator().manual_seed(seed)
    z = torch.randn(many, 3, generator=generator, dtype=torch.float64)
    shape = torch.randn(many, 8, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        return z, shape, model.decode(z, shape)


def test_the_decoder_returns_the_mean_of_the_program(model):
    z, shape, x = draw_segments(model, 3)
    program = poutine.condition(model.model, data={"z": z})
    parts = program({SHAPE: shape}, length=100, mean_emission=True)
    torch.testing.assert_close(model.to_data_space(parts)["x"], x)
    torch.testing.assert_close(model.decode(z[:, None], shape[:, None]), x[:, None])
    some = torch.tensor([0, 40, 99])
    torch.testing.assert_close(model.decode(z, shape, some), x[:, some])


def test_times_are_matched_in_decoded_time(model):
    x = draw_segments(model, 2)[2].requires_grad_()
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
    # later times of all frames match an earlier frame
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
def test_decoded_segments_are_recovered(model, kind, options):
    """The mode is at least as probable as the truth; with unassigned points, its error is comparable."""
    z, shape, x = draw_segments(model, 2)
    observed = simulate_observations(model, x, shape, kind, **options)
    completed = complete(model, observed, descent=THOROUGH)
    if kind == "points":
        energy, true_energy = (
            model.vertices(*each)[:, observed["frames"][0].long()]
            for each in ((completed.x, completed.shape), (x, shape))
        )
        assert chamfer(observed["points"], energy).mean() < 1.5 * chamfer(observed["points"], true_energy).mean()
    else:
        truth = poutine.condition(SegmentCompletion(model), data={"z": z, SHAPE: shape})
        trace = poutine.trace(truth).get_trace(completed.observations)
        assert completed.posterior.energy.sum() <= -trace.log_prob_sum()
        error = bodies.vertex_error(model.vertices(completed.x, completed.shape), model.vertices(x, shape))
        assert error.max() < 0.02
        assert completed.posterior.left.max() < 0.01
    with_shape = complete(model, {**observed, SHAPE: shape}, descent=BRIEF)
    assert torch.equal(with_shape.shape, shape)
    assert set(with_shape.posterior.mode) == {"z"}
    draws = completed.draw(5)
    assert draws[0].shape == (5, *x.shape)
    assert draws[1].shape == (5, *shape.shape)


def test_intervals_of_completions_have_their_coverage(model):
    """Test segments of the model with its marker noise within four binomial standard errors."""
    z, shape, x = draw_segments(model, 120, seed=3)
    noise = Deviations(marker=0.05)
    observed = simulate_observations(model, x, shape, "markers", frames=[10, 60])
    observed["markers"] = observed["markers"] + noise.marker * torch.randn_like(observed["markers"])
    completed = complete(model, {**observed, SHAPE: shape}, deviations=noise, descent=BRIEF)
    distance = ((z - completed.posterior.mode["z"]) / completed.posterior.deviation["z"]).abs()
    for level in (0.5, 0.8, 0.9):
        reach = torch.distributions.Normal(0.0, 1.0).icdf(torch.tensor((1 + level) / 2))
        error = (level * (1 - level) / z.numel()) ** 0.5
        assert abs((distance < reach).double().mean() - level) < 4 * error
        assert abs((distance < reach / 2).double().mean() - level) > 4 * error


def test_missing_observations_change_nothing(model):
    z, shape, x = draw_segments(model, 2)
    program = SegmentCompletion(model)
    observed = simulate_observations(model, x, shape, "markers", frames=[5, 50, 80])

    def energy(observations):
        conditioned = poutine.condition(program, data={"z": z + 0.1, SHAPE: shape})
        return poutine.trace(conditioned).get_trace(program.read(observations)).log_prob_sum()

    cut = {name: value[:, :2] for name, value in observed.items()}
    incomplete = {name: value.clone() for name, value in observed.items()}
    for value in incomplete.values():
        value[:, 2] = torch.nan
    torch.testing.assert_close(energy(incomplete), energy(cut))
    assert energy(cut) != energy(observed)
    timed = {**observed, "times": model.timed.times(x)[:, [5, 50, 80]]}
    late = {**timed, "times": timed["times"] + 0.1}
    assert energy(late) < energy(timed)


@pytest.mark.parametrize("two_way", [False, True])
def test_points_are_compared_with_the_nearest_vertices(model, two_way):
    _, shape, x = draw_segments(model, 2)
    rotations, places = model.timed.poses(x[:, ::30])
    vertices = model.body(shape, rotations, places)[0]
    points = vertices[:, :, ::100] + 0.01 * torch.randn(2, 4, 15, 3, dtype=torch.float64)
    nearest = nearest_vertices(model.body, shape, rotations, places, points)
    assert torch.equal(nearest, torch.cdist(points, vertices).argmin(-1))
    program, (z, shape, x) = SegmentCompletion(model, two_way=two_way), draw_segments(model, 2)
    observed = program.read(simulate_observations(model, x, shape, "points", frames=[0, 50]))
    values = {"z": z, SHAPE: shape}
    runs = [poutine.trace(poutine.condition(program, values)) for _ in range(2)]
    batches = observed, program.renewed(observed, values)
    computed, given_nearest = (run.get_trace(batch).log_prob_sum() for run, batch in zip(runs, batches, strict=True))
    torch.testing.assert_close(computed, given_nearest)


def test_a_two_way_error_adds_the_distances_of_vertices_from_their_nearest_points(model):
    """All vertices of a frame weigh as much as its points; missing points are never the nearest."""
    z, shape, x = draw_segments(model, 2)
    observed = simulate_observations(model, x, shape, "points", frames=[0, 50], points=20)
    observed["points"][:, :, 4:8] = torch.nan
    observed["points"][1, 1] = torch.nan  # an empty frame has no error
    programs = [SegmentCompletion(model, two_way=two_way) for two_way in (False, True)]
    values = {"z": z, SHAPE: shape}
    batch = programs[0].read(observed)
    one, both = (poutine.trace(poutine.condition(each, values)).get_trace(batch) for each in programs)
    vertices = model.body(shape, *model.timed.poses(x[:, [0, 50]]))[0][:, :, ::THIN]
    frames = [(vertices[b, k], observed["points"][b, k]) for b, k in ((0, 0), (0, 1), (1, 0))]
    nearest = torch.stack([torch.cdist(v, p[p.isfinite().all(-1)]).amin(-1) for v, p in frames])
    deviation = 0.1 * (vertices.shape[2] / 16) ** 0.5
    normal = torch.distributions.Normal(torch.zeros((), dtype=torch.float64), deviation)
    expected = normal.log_prob(nearest).sum() + 2 * nearest.numel() * normal.log_prob(normal.mean)
    torch.testing.assert_close(both.log_prob_sum() - one.log_prob_sum(), expected)
    distances = programs[0].distances(batch, z, shape)
    torch.testing.assert_close(distances[TO_POINTS], torch.stack([nearest[:2].mean(), nearest[2].mean()]))


def test_known_segments_determine_the_prior(model, segments):
    """Without information on z, the posterior has the mean and variance of the known segments, else the prior's."""
    batch = {name: value.double() for name, value in segments.all().items()}
    distribution = model.posterior(batch)
    z, shape, x = draw_segments(model, 2)
    observed = {**simulate_observations(model, x, shape, "markers", frames=[0]), SHAPE: shape}
    options = {"deviations": Deviations(marker=1e6, time=1e6), "descent": BRIEF}
    informed, uninformed = (
        complete(model, observed, known=batch, aggregate=each, **options).posterior for each in (True, False)
    )
    wide = _shrink(distribution.mean, distribution.variance.mean(0)).diagonal()
    torch.testing.assert_close(informed.mode["z"], distribution.mean.mean(0).expand(2, -1))
    torch.testing.assert_close(informed.deviation["z"], wide.sqrt().expand(2, -1))
    torch.testing.assert_close(uninformed.mode["z"], torch.zeros_like(z))
    torch.testing.assert_close(uninformed.deviation["z"], torch.ones_like(z))


def test_a_covariance_of_few_draws_is_shrunk():
    """By hand for 50 draws with covariance diag(3, 1): the share is 4^2 / (50 (10 - 4^2 / 2)) = .16, towards 2."""
    by_hand = _shrink(torch.zeros(50, 2), torch.tensor([3.0, 1.0]))
    torch.testing.assert_close(by_hand, torch.tensor([2.84, 1.16]).diag())
    root = torch.randn(6, 6).double() * torch.tensor([2.0, 1, 1, 0.5, 0.5, 0.1])
    truth, none = root @ root.mT, torch.zeros(6).double()
    assert torch.linalg.eigvalsh(_shrink(torch.randn(5, 6).double() @ root.mT, none))[0] > 1e-3
    many = torch.randn(200_000, 6).double() @ root.mT
    torch.testing.assert_close(_shrink(many, none), truth, rtol=0, atol=0.02 * float(truth.trace()))
    torch.testing.assert_close(_shrink(many[:1], none + 3), 3 * torch.eye(6).double())


def test_scans_are_uniform_and_errors_are_at_the_requested_time(model):
    _, shape, x = draw_segments(model, 3)
    vertices = model.vertices(x[:, :1].expand(-1, 100, -1), shape)[:, :2]
    points = sample_surfaces(vertices, model.body.faces, 4000, torch.Generator().manual_seed(0))
    assert chamfer(points, vertices).max() < 0.02
    far = vertices.float() + 30  # metres; float32 keeps 2 micrometres there
    assert chamfer(far, far).max() == 0
    assert chamfer(torch.where(torch.rand(*points.shape[:-1], 1) < 0.5, points, torch.nan), vertices).isfinite().all()
    # the share of points above the pelvis is the share of area
    first, second, third = (vertices[0, 0][model.body.faces[:, n]] for n in range(3))
    area = (second - first).cross(third - first, dim=-1).norm(dim=-1)
    share = float(area[(first + second + third)[:, 1] / 3 > 0].sum() / area.sum())
    error = (share * (1 - share) / 4000) ** 0.5
    assert (
        abs(float((points[0, 0, :, 1] > 0).double().mean()) - share) < 4 * error + 0.02
    )  # triangles across the pelvis

    longest, displaced = float(model.timed.lasts(x).max()), x.clone()
    displaced[..., model.timed.parts["translation"][1]] += 0.1 / model.timed.metres
    errors, many = error_by_time(model, (displaced, shape), (x, shape), [0.0, 0.1, longest, longest + 1])
    assert many.tolist() == [3, 3, 1, 0]
    torch.testing.assert_close(errors[:2], torch.full((2,), 0.1, dtype=torch.float64))
    assert errors[3].isnan()
    surfaces = surfaces_at(model, x, shape, model.timed.times(x)[:, [20]])
    torch.testing.assert_close(surfaces, model.vertices(x, shape)[:, [20]])


def test_recovered_segments_are_scored_and_become_motion(model):
    _, shape, x = draw_segments(model, 2)
    observed = simulate_observations(model, x, shape, "markers", frames=range(0, 100, 20))
    keys, truth = [("a", "first"), ("b", "second")], {"x": x, SHAPE: shape}
    recovered = recover(model, {**observed, SHAPE: shape}, keys, truth=truth, descent=THOROUGH)
    assert recovered.distances["markers"].max() < 1e-3
    assert recovered.errors["vertex error"].max() < 2e-3
    lasts = model.timed.lasts(recovered.completed.x)
    torch.testing.assert_close(recovered.errors["duration error"], (lasts - model.timed.lasts(x)).abs())
    moving, true = recovered.motion(draws=2), recovered.true_motion()
    assert [clip.key for clip in moving][::3] == [("a", "first-found"), ("b", "second-found")]
    assert [clip.key for clip in true] == keys
    for clip, true_positions, seconds in zip(moving.clips[::3], true, lasts.tolist(), strict=True):
        assert 0 <= seconds - (clip.frames - 1) / moving.skeleton.fps < 1 / moving.skeleton.fps + 1e-3
        shorter = min(clip.frames, true_positions.frames)
        assert abs(clip.positions[:shorter] - true_positions.positions[:shorter]).max() < 0.02
    for table in recovered.table().renderables:
        assert [str(cell) for cell in table.columns[0].cells] == ["a/first", "b/second"]
    with pytest.raises(ValueError, match="segment 1 of 2, counted from 0, has only NaN"):
        recover(
            model,
            {**observed, "markers": observed["markers"] * torch.tensor([1.0, torch.nan])[:, None, None, None]},
            keys,
        )


def test_impossible_observations_are_errors(model):
    _, shape, x = draw_segments(model, 2)
    observed = simulate_observations(model, x, shape, "markers", frames=[0, 50])
    program = SegmentCompletion(model)
    for wrong, message in (
        ({**observed, "marker": observed["markers"]}, "unknown observations marker"),
        ({"frames": observed["frames"]}, "expected observations surfaces, points or markers"),
        ({"markers": observed["markers"]}, "with their moments"),
        (
            {**observed, "markers": observed["markers"][:, :, :5]},
            r"markers has shape \(2, 2, 5, 3\), expected \(2, 2, 16, 3\)",
        ),
        ({**observed, "frames": observed["frames"] + 60}, "from 0 to 99, got 60 to 110"),
        ({**observed, SHAPE: shape * torch.nan}, "beta must be given for all segments"),
    ):
        with pytest.raises(ValueError, match=message):
            program.read(wrong)
    with pytest.raises(ValueError, match="expected 'surfaces', 'points' or 'markers'"):
        simulate_observations(model, x, shape, "marker")
    with pytest.raises(ValueError, match="marker"):
        Deviations(marker=0.0)


def test_markers_lie_where_their_names_indicate():
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
