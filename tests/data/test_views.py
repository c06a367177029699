"""Views: bijections with log-determinants, and models with a view equal models of transformed data."""

import pyro
import pytest
import torch

import dvae
from dvae.data.batch import Batch
from dvae.data.views import Dequantised, History, Parts, Past, View, Views
from dvae.distributions.families import FixedNormal
from dvae.inference.bounds.predictive import predictive_bound
from dvae.models.motion.trajectories import OtherJoints
from dvae.motion import HUMANEVA, WALKER, Bones, Heading, rotate_about_up
from dvae.networks import Recurrent

B, T, J = 3, 5, WALKER.joints
D = 3 * J - 3
LEGS = [i for i in range(D) if i % 6 < 3]
ARMS = [i for i in range(D) if i % 6 >= 3]
TURNED = ("x", "s", "y", "r", "legs", "arms")
VIEWS = {
    "identity": (View(), D),
    "parts and history": (Views(History("h"), Parts({"legs": LEGS, "arms": ARMS})), D),
    "first frame": (Past("s"), D),
    "heading": (Heading(WALKER, 3), D),
    "heading of parts": (Views(Heading(WALKER, 3, turned=TURNED), Parts({"legs": LEGS, "arms": ARMS})), D),
    "heading of a first pose": (Views(Past("s"), OtherJoints(True), Heading(WALKER, pose="s", turned=TURNED)), 3 * J),
}


def people(*shape):
    return torch.randn(*shape, dtype=torch.float64)


def turn(x, angle, skeleton=WALKER):
    joints = x.unflatten(-1, (-1, 3))
    return rotate_about_up(joints, torch.as_tensor(angle, dtype=x.dtype), skeleton.up).flatten(-2)


@pytest.fixture(params=VIEWS)
def view_and_data(request):
    view, size = VIEWS[request.param]
    return view, Batch(x=people(B, T, size))


def test_inverse_undoes_a_view_and_a_second_call_changes_nothing(view_and_data):
    view, data = view_and_data
    transformed = view(data)
    torch.testing.assert_close(view.inverse(transformed)["x"], data["x"])
    twice = view(transformed)  # a second call changes nothing
    assert transformed.keys() == twice.keys()
    assert all(torch.equal(transformed[name], twice[name]) for name in transformed)


def test_samples_of_the_future_are_inverted_with_entries_of_the_past(view_and_data):
    """The batch has future values (S, B, H, D) and the entries that the view added to the past."""
    view, data = view_and_data
    past, future = data["x"], people(B, 7, data["x"].shape[-1])
    past_view = view(Batch({"x": past}))
    added = {name: past_view[name] for name in view.names if name in past_view}
    if isinstance(view, Past) or "s" in past_view:  # the future continues from the first frame
        future_view = {n: v for n, v in view(Batch({"x": torch.cat([past[:, :1], future], 1)})).items() if n != "s"}
    else:
        future_view = view(Batch({"x": future}), past_view)
    samples = {
        name: value.expand(2, *value.shape)
        for name, value in future_view.items()
        if name not in ("heading", "h", "y", "r")
    }
    torch.testing.assert_close(view.inverse(Batch({**added, **samples}))["x"], future.expand(2, *future.shape))


def test_views_keep_volume(view_and_data):
    """Autograd's Jacobian, at the heading of the window, has the same log-determinant."""
    view, data = view_and_data
    heading = {"heading": torch.tensor([0.7], dtype=torch.float64)}
    view_inputs = heading if "heading" in view.names and "s" not in view(data) else None
    names = [name for name in view(data) if name not in ("heading", "h", "y", "r")]

    def flat_view(x):
        transformed = view(Batch({"x": x[None]}), view_inputs)
        return torch.cat([transformed[name].flatten() for name in names])

    if "s" in names and "heading" in view.names:  # "s" determines the heading, which rotates the rest
        first, names = data["x"][0, :1], ["x"]
        jacobian = torch.autograd.functional.jacobian(lambda x: flat_view(torch.cat([first, x])), data["x"][0, 1:])
    else:
        jacobian = torch.autograd.functional.jacobian(flat_view, data["x"][0])
    rows = len(jacobian)
    _, log_det = torch.linalg.slogdet(jacobian.reshape(rows, rows))
    torch.testing.assert_close(log_det, view.log_det(data)[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("skeleton", [WALKER, HUMANEVA])
def test_every_window_faces_one_way_and_is_otherwise_unchanged(skeleton):
    x = people(B, T, 3 * skeleton.joints)
    for angle in (0.0, 2.5):
        transformed = Heading(skeleton, 2)(Batch({"x": turn(x, angle, skeleton)}))
        torch.testing.assert_close(
            skeleton.heading(transformed["x"].unflatten(-1, (-1, 3))[:, 1]), torch.zeros(B).double()
        )
        torch.testing.assert_close(transformed["x"], Heading(skeleton, 2).face(x))


# -------------------------------------------------------------------------------------------------- models with views


def build(view):
    torch.manual_seed(0)
    sizes = {"z": 2, "x": D}
    equations = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"
    return dvae.DynamicalVAE(*equations, sizes, Recurrent(4), view=view).double().eval()


def seeded(call, *arguments, **options):
    torch.manual_seed(1)
    return call(*arguments, **options)


def with_missing():
    """Return windows, and a mask of whole joints and of heights, with a complete third pose."""
    x, observed = people(B, T, D), torch.rand(B, T, J - 1, 1) < 0.7
    mask = observed.expand(-1, -1, -1, 3).clone()
    mask[..., WALKER.vertical] &= torch.rand(B, T, J - 1) < 0.8
    mask[:, 2] = True
    return x, mask.flatten(-2)


@pytest.mark.parametrize("hidden", [50.0, torch.nan])
def test_missing_entries_through_a_view_equal_those_of_rotated_windows(hidden):
    heading = Heading(WALKER, 3)
    model, plain = build(heading), build(None)
    x, mask = with_missing()
    angle = heading.of(x)
    batch = {"x": torch.where(mask, x, hidden), "mask": mask}
    rotated = {"x": heading.face(x), "mask": mask}
    imputed = seeded(plain.reconstruct, rotated, 2)["x"]
    torch.testing.assert_close(seeded(model.reconstruct, batch, 2)["x"], turn(imputed, angle[:, None, None]))
    elbo = dvae.SequenceELBO()
    torch.testing.assert_close(seeded(elbo.terms, model, batch).bound, seeded(elbo.terms, plain, rotated).bound)
    past, rotated_past = ({name: value[:, :4] for name, value in each.items()} for each in (batch, rotated))
    future = seeded(plain.forecast, rotated_past, 3, 2, draw_emission=True)["x"]
    forecast = seeded(model.forecast, past, 3, 2, draw_emission=True)["x"]
    torch.testing.assert_close(forecast, turn(future, angle[:, None, None]))


def test_masks_and_sizes_that_cannot_be_rotated_are_an_error():
    model, (x, mask) = build(Heading(WALKER, 3)), with_missing()
    half = mask.clone()
    half[1, 4, 6:9] = torch.tensor([True, True, False])
    with pytest.raises(ValueError, match="window 1 is missing only one of the two horizontal coordinates"):
        model.guide({"x": x, "mask": half})
    with pytest.raises(ValueError, match=r"the mask of x is torch\.float64"):
        model.guide({"x": x, "mask": mask.double()})
    with pytest.raises(ValueError, match="have 51 coordinates, or 48 without the root"):
        model.guide(x[..., :30])


def without(mask, window, frames, *names):
    """Return the mask without some joints of one window in some frames."""
    mask = mask.clone()
    for name in names:
        joint = 3 * (WALKER.names.index(name) - 1)
        mask[window, frames, joint : joint + 3] = False
    return mask


LEFT, RIGHT = ("LHip", "LShoulder"), ("RHip", "RShoulder")


@pytest.mark.parametrize(
    ("frames", "names", "frame"),
    [
        ([1, 2], RIGHT, 0),  # no right side: the previous pose
        ([2], ["LHip"], 1),  # a complete pose is preferred to one with a shoulder only
        ([0, 1, 2], ["LHip", "RHip"], 2),  # the sides that are observed
    ],
)
def test_the_nearest_pose_with_hips_and_shoulders_determines_the_heading(frames, names, frame):
    x = people(B, T, D)
    mask = without(torch.ones_like(x, dtype=torch.bool), 1, frames, *names)
    hidden = torch.where(mask, x, torch.nan)
    transformed = Heading(WALKER, 3)(Batch({"x": hidden, "mask": {"x": mask}}))
    joints = WALKER.with_root(x.unflatten(-1, (-1, 3)))
    expected = WALKER.heading(joints[:, 2])
    pose = WALKER.with_root(hidden.unflatten(-1, (-1, 3)))[1, frame]
    lateral = torch.stack([pose[WALKER.names.index(n)] for n in LEFT]).nanmean(0)
    lateral -= torch.stack([pose[WALKER.names.index(n)] for n in RIGHT]).nanmean(0)
    expected[1] = torch.atan2(lateral[0], lateral[2]) - torch.pi / 2
    difference = transformed["heading"] - expected
    torch.testing.assert_close(torch.sin(difference), torch.zeros_like(difference), atol=1e-9, rtol=0)
    assert (torch.cos(difference) > 0).all()
    torch.testing.assert_close(Heading(WALKER, 3).inverse(transformed)["x"][mask], x[mask])


@pytest.mark.parametrize("n_missing", [T, 3])  # all frames, or those up to the pose
def test_a_window_without_a_heading_is_not_rotated(n_missing):
    x = people(B, T, D)
    mask = without(torch.ones_like(x, dtype=torch.bool), 1, slice(n_missing), *LEFT)
    transformed = Heading(WALKER, 3)(Batch({"x": x, "mask": {"x": mask}}))
    assert transformed["heading"][1] == 0
    assert torch.equal(transformed["x"][1][mask[1]], x[1][mask[1]])
    past = Heading(WALKER, 3)(Batch({"x": x[:, :3], "mask": {"x": mask[:, :3]}}))
    torch.testing.assert_close(past["heading"], transformed["heading"])  # a forecast is rotated as in training


def test_samples_conditional_on_a_batch_are_rotated_back():
    """Samples pass through the inverse view. Without a batch they have no heading."""
    model, x = build(Heading(WALKER, 3)), people(B, T, D)
    torch.testing.assert_close(model.sample(batch=x)["x"], x)
    assert model.sample(2, length=4)["x"].shape == (2, 4, D)


def test_a_fixed_part_is_returned_bit_for_bit_and_rotated_for_the_model():
    view = Views(Heading(WALKER, 3, turned=TURNED), Parts({"legs": LEGS, "arms": ARMS}))
    equations = "p(z) p(legs_t | legs_{<t}, z) p(arms_t | legs_{<=t}, arms_{<t}, z)", "q(z | legs_{1:T}, arms_{1:T})"
    sizes = {"z": 2, "legs": len(LEGS), "arms": len(ARMS)}
    model = dvae.DynamicalVAE(*equations, sizes, Recurrent(4), view=view).double().eval()
    past, legs = people(B, 4, D), people(B, 3, len(LEGS))
    future = seeded(model.forecast, past, 3, 2, fix={"legs": legs})
    assert torch.equal(future["legs"], legs.expand(2, -1, -1, -1))
    assert torch.equal(future["x"][..., LEGS], future["legs"])
    rotated = seeded(model.forecast, turn(past, 1.0), 3, 2, fix={"legs": turn(legs, 1.0)})
    torch.testing.assert_close(rotated["x"], turn(future["x"], 1.0))


# ------------------------------------------------------------------------------------------------- bones

BONES = {
    "no root": (Bones(WALKER, 4), D),
    "a root": (Bones(WALKER, 4), 3 * J),
    "pieces": (Views(Bones(WALKER, 4, {"legs": LEGS, "arms": ARMS}), Parts({"legs": LEGS, "arms": ARMS})), D),
    "turned": (Views(Heading(WALKER, 4, turned=TURNED), Bones(WALKER, 4)), D),
}


def rigid(frames, size, skeleton=WALKER):
    """Return poses (B, T, D) with constant bone lengths, joint by joint from the root."""
    x, lengths = people(B, frames, skeleton.joints, 3), torch.rand(B, 1, skeleton.joints, 1, dtype=torch.float64) + 0.1
    for joint in skeleton.order[1:]:
        direction = x[:, :, joint] / x[:, :, joint].norm(dim=-1, keepdim=True)
        x[:, :, joint] = x[:, :, skeleton.parents[joint]] + lengths[:, :, joint] * direction
    return (x if size == 3 * skeleton.joints else skeleton.without_root(x - x[:, :, :1])).flatten(-2)


def lengths_of(x, skeleton=WALKER):
    return skeleton.bone_lengths(skeleton.with_root(x.unflatten(-1, (-1, 3))))


@pytest.fixture(params=BONES)
def bones_and_data(request):
    view, size = BONES[request.param]
    return view, rigid(6, size)


def test_directions_of_bones_have_length_one_and_are_inverted_to_rigid_people(bones_and_data):
    view, x = bones_and_data
    transformed = view(Batch({"x": x}))
    directions = (
        transformed["x"] if "x" in transformed else Parts({"legs": LEGS, "arms": ARMS}).inverse(transformed)["x"]
    )
    joints = directions.unflatten(-1, (-1, 3))
    bones = joints if joints.shape[2] < J else WALKER.without_root(joints)
    torch.testing.assert_close(bones.norm(dim=-1), torch.ones_like(bones[..., 0]))
    torch.testing.assert_close(view.inverse(transformed)["x"], x)
    twice = view(transformed)
    assert all(torch.equal(twice[name], transformed[name]) for name in transformed)


def test_the_inverse_of_any_directions_keeps_bone_lengths(bones_and_data):
    """Arbitrary numbers (S, B, H, D) replace the directions. The root position is kept."""
    view, x = bones_and_data
    transformed = view(Batch({"x": x}))
    samples = {name: people(2, B, 7, value.shape[-1]) for name, value in transformed.items() if value.dim() == 3}
    added = {name: value for name, value in transformed.items() if value.dim() < 3}
    inverse = view.inverse(Batch({**samples, **added}))
    torch.testing.assert_close(lengths_of(inverse["x"]), lengths_of(x)[:, :1].expand(2, -1, 7, -1))
    if x.shape[-1] == 3 * J:
        torch.testing.assert_close(inverse["x"][..., :3], samples["x"][..., :3])
    if "legs" in inverse:
        assert torch.equal(inverse["legs"], inverse["x"][..., LEGS])


def test_bone_lengths_are_means_over_observed_frames_without_padding():
    x = people(B, 6, D)
    lengths = lengths_of(x)
    torch.testing.assert_close(Bones(WALKER, 4)(Batch({"x": x}))["bone_lengths"], lengths[:, :4].mean(1))
    steps = torch.tensor([2, 6, 3])
    expected = torch.stack([lengths[n, : min(4, t)].mean(0) for n, t in enumerate(steps)])
    torch.testing.assert_close(Bones(WALKER, 4)(Batch({"x": x, "lengths": steps}))["bone_lengths"], expected)


def test_directions_have_no_density_and_need_both_joints():
    x, view = rigid(5, D), Bones(WALKER, 3)
    with pytest.raises(ValueError, match=r"directions of bones has no density of positions: lengths are given"):
        view.log_det(Batch({"x": x}))
    with pytest.raises(ValueError, match="no density of positions"):
        dvae.SequenceELBO().terms(build(view), x)
    mask = torch.ones_like(x, dtype=torch.bool)
    assert torch.equal(view(Batch({"x": x, "mask": {"x": mask}}))["x"], view(Batch({"x": x}))["x"])
    mask[1, 2, 5] = False
    with pytest.raises(
        ValueError, match="window 1 has missing entries in frame 3, but this model sees the directions of"
    ):
        view(Batch({"x": x, "mask": {"x": mask}}))


def test_a_part_without_its_parent_joint_is_an_error():
    knee = [i for i in range(D) if i // 3 in (1, 2)]  # of the joints without the root: RKnee, RFoot
    rest = [i for i in range(D) if i not in knee]
    view, x = Bones(WALKER, 4, {"shank": knee, "rest": rest}), rigid(4, D)
    transformed = view(Batch({"x": x, "shank": x[..., knee]}))
    assert torch.equal(transformed["shank"], transformed["x"][..., knee])
    assert torch.equal(view(Batch({"rest": x[..., rest]}), transformed)["rest"], transformed["x"][..., rest])
    with pytest.raises(ValueError, match="shank alone does not determine the direction of RKnee, whose parent is RHip"):
        view(Batch({"shank": x[..., knee]}), transformed)


def test_a_model_of_directions_forecasts_rigid_people_and_has_no_bound():
    torch.manual_seed(0)
    equations = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"
    distribution = {"p(x)": dvae.distributions.Directions(residual=0.5)}
    model = (
        dvae.DynamicalVAE(*equations, {"z": 2, "x": D}, Recurrent(4), distribution, view=Bones(WALKER, 4))
        .double()
        .eval()
    )
    x = rigid(4, D)
    future = seeded(model.forecast, x, 5, 3)["x"]
    torch.testing.assert_close(lengths_of(future), lengths_of(x)[:, :1].expand(3, -1, 5, -1))
    assert not model.likelihood
    assert not dvae.SequenceELBO().terms(model, x).likelihood
    with pytest.raises(ValueError, match="has no likelihood"):
        dvae.iwae_bound(model, x, 2)


# --------------------------------------------------------------------------------------------- views that change volume

FACTORS = torch.tensor([0.5, -2.0, 3.0], dtype=torch.float64)
MIXING = torch.tensor([[2.0, 1.0, 0.0], [0.0, 0.5, 0.3], [0.1, 0.0, 3.0]], dtype=torch.float64)


class Scaled(View):
    """Each coordinate of x, multiplied by its factor."""

    def __call__(self, data, view_inputs=None):
        return {**data, "x": data["x"] * FACTORS} if "x" in data and "log_det" not in data else dict(data)

    def inverse(self, model_values):
        return {**model_values, "x": model_values["x"] / FACTORS} if "x" in model_values else dict(model_values)

    def log_det(self, data):
        return FACTORS.abs().log().expand_as(data["x"])


class Mixed(Scaled):
    """Frames, multiplied by a matrix; the log-determinant is one number for each sequence."""

    def __call__(self, data, view_inputs=None):
        return {**data, "x": data["x"] @ MIXING} if "x" in data and "log_det" not in data else dict(data)

    def inverse(self, model_values):
        if "x" not in model_values:
            return dict(model_values)
        return {**model_values, "x": model_values["x"] @ MIXING.inverse()}

    def log_det(self, data):
        return torch.full((len(data["x"]),), data["x"].shape[1] * MIXING.logdet().item(), dtype=data["x"].dtype)


SMALL = ("p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 2, "x": 3})
ESTIMATES = {
    "bound": lambda model, batch: dvae.SequenceELBO().terms(model, batch).bound,
    "importance": lambda model, batch: dvae.iwae_bound(model, batch, particles=8, chunk=9).bound,
    "particles": lambda model, batch: dvae.fivo_bound(model, batch, particles=8, chunk=24).bound,
    "joint": lambda model, batch: sum(model.log_joint(batch, {"z": torch.ones(B, T, 2).double()}).values()),
    "Pyro's": lambda model, batch: torch.tensor([-pyro.infer.Trace_ELBO().loss(model, model.guide, batch)]),
}


def with_view(view):
    torch.manual_seed(0)
    return dvae.DynamicalVAE(*SMALL, Recurrent(4), view=view).double().eval()


def incomplete(kind):
    """Return windows, their mask or lengths, and which entries count."""
    counts = torch.ones(B, T, 3, dtype=torch.bool)
    entries = {}
    if "mask" in kind:
        counts = torch.rand(B, T, 3) < 0.7
        entries["mask"] = counts
    if "lengths" in kind:
        entries["lengths"] = torch.tensor([2, T, 4])
        counts = counts & (torch.arange(T) < entries["lengths"][:, None])[..., None]
    return people(B, T, 3), entries, counts


@pytest.mark.parametrize(
    ("kind", "estimate"), [("mask" if n % 2 else "mask and lengths", name) for n, name in enumerate(ESTIMATES)]
)
def test_densities_are_those_of_the_given_data(estimate, kind):
    """The density of the scaled data plus the log-determinant of the observed entries is the density of the data."""
    x, entries, counts = incomplete(kind)
    view = Scaled()
    batch, scaled = {"x": x, **entries}, {"x": x * FACTORS, **entries}
    expected = torch.where(counts, view.log_det(batch), 0.0).sum((1, 2))
    plain, with_scaling = (
        seeded(ESTIMATES[estimate], with_view(v), data) for v, data in ((None, scaled), (view, batch))
    )
    torch.testing.assert_close(with_scaling, plain + (expected if len(plain) == B else expected.sum()))
    assert (expected.abs() > 0.1).all()


@pytest.mark.parametrize("estimate", ESTIMATES)
def test_a_log_determinant_of_whole_sequences_requires_complete_sequences(estimate):
    x, model = people(B, T, 3), with_view(Mixed())
    plain, mixed = (seeded(ESTIMATES[estimate], m, v) for m, v in ((with_view(None), x @ MIXING), (model, x)))
    torch.testing.assert_close(mixed, plain + T * MIXING.logdet() * (B / len(plain)))
    for partial in ("mask", "lengths"):
        _, entries, _ = incomplete(partial)
        with pytest.raises(
            ValueError, match=rf"log_det of .* has shape \(3,\), for data with {partial}; expected \(B,\)"
        ):
            ESTIMATES[estimate](model, {"x": x, **entries})


def test_the_log_score_includes_the_log_determinant_of_the_future():
    x, n_observed = people(B, T, 3), 3
    plain = seeded(predictive_bound, with_view(None), x * FACTORS, n_observed, 8).bound
    scaled = seeded(predictive_bound, with_view(Scaled()), x, n_observed, 8).bound
    torch.testing.assert_close(scaled, plain + (T - n_observed) * FACTORS.abs().log().sum())
    with pytest.raises(ValueError, match="the part of the future is unknown"):
        predictive_bound(with_view(Mixed()), x, n_observed, 8)


def test_the_oracle_of_a_scaled_model_is_the_density_of_the_data():
    model = dvae.linear_gaussian_surrogate(*SMALL, T)
    x = people(B, T, 3)
    mean, precision = dvae.Oracle(model, T)._joint()
    scale = FACTORS.repeat(T)
    covariance = precision.inverse()[-3 * T :, -3 * T :] / scale / scale[:, None]
    expected = torch.distributions.MultivariateNormal(mean[-3 * T :] / scale, covariance).log_prob(x.flatten(1))
    arguments = model.generative, model.inference, model.sizes, model.networks, model.distributions
    scaled = dvae.DynamicalVAE(*arguments, view=Scaled()).double()
    scaled.load_state_dict(model.state_dict())
    torch.testing.assert_close(dvae.Oracle(scaled, T).evidence(x), expected)


def test_composed_views_add_their_log_determinants():
    parts = Parts({"legs": [0, 2], "arms": [1]})
    x, entries, counts = incomplete("mask and lengths")
    view, data = Views(Scaled(), parts), Batch({"x": x, **entries, "mask": {"x": entries["mask"]}})
    by_entry = torch.where(counts, Scaled().log_det(data), 0.0)
    torch.testing.assert_close(view.log_det(data), by_entry.sum((1, 2)))
    torch.testing.assert_close(view.counted(data), by_entry.sum(2))
    both = Views(Scaled(), Mixed())
    torch.testing.assert_close(
        both.log_det(Batch({"x": x})), T * (FACTORS.abs().log().sum() + MIXING.logdet()).expand(B)
    )
    assert not view.keeps_volume
    assert Views(parts, History("h")).keeps_volume
    with pytest.raises(ValueError, match="changes the volume of steps that are not scored"):
        Views(Scaled(), Past("s"))
    assert Views(Past("s"), Scaled()).log_det(Batch({"x": x})).shape == (B,)


def test_a_scaled_model_forecasts_unscaled_data_and_is_fitted_to_their_bound():
    x, model, plain = people(B, T, 3), with_view(Scaled()), with_view(None)
    future = seeded(plain.forecast, x * FACTORS, 3, 2, draw_emission=True)["x"]
    torch.testing.assert_close(seeded(model.forecast, x, 3, 2, draw_emission=True)["x"], future / FACTORS)
    added = FACTORS.abs().log().sum().item()
    fit, plain_fit = (
        dvae.fit(m, data, data, steps=2, validate_every=1, log_every=1, progress=False)
        for m, data in ((model, x), (plain, x * FACTORS))
    )
    assert fit.best_bound == pytest.approx(plain_fit.best_bound + added)
    assert fit.series("loss")[1] == pytest.approx([loss - added for loss in plain_fit.series("loss")[1]])


def constant_model(scale, view=None):
    """Return x ~ N(0, scale²) at every step, independent of the context."""
    family = FixedNormal(scale=scale, learned=False)
    model = dvae.DynamicalVAE("p(x_t | c_t)", None, {"x": 2, "c": 1}, Recurrent(2), family, view=view).double()
    for parameter in model.parameters():
        parameter.data.zero_()
    return model.eval()


WIDTHS = (0.5, 0.25)


def test_rounding_noise_is_uniform_and_returning_values_are_rounded():
    view = Dequantised((0.5, 0.0))
    x = torch.randint(-9, 9, (400, T, 2)).double() / 2
    viewed = view(Batch(x=x))
    noise = (viewed["x"] - x)[..., 0]
    assert noise.abs().max() <= 0.25
    torch.testing.assert_close(noise.var(), torch.tensor(0.25 / 12).double(), rtol=0.1, atol=0)
    assert torch.equal(viewed["x"][..., 1], x[..., 1])
    assert torch.equal(view.inverse(viewed)["x"], x)
    assert view.inverse(viewed).keys() == {"x"}
    assert torch.equal(view(viewed)["x"], viewed["x"])  # one noise for each reading
    assert not torch.equal(view(Batch(x=x))["x"], viewed["x"])
    with pytest.raises(ValueError, match="rounding noise has 2 widths, but x has size 3"):
        dvae.DynamicalVAE(*SMALL, Recurrent(4), view=view)


@pytest.mark.parametrize("scale", [2.0, 0.3, 0.02, 1e-4])
def test_a_bound_of_rounded_values_is_at_most_their_exact_probability(scale):
    """The exact probability is that of the cell of each rounded value; without noise, the density exceeds it."""
    widths, x = torch.tensor(WIDTHS).double(), torch.tensor([[0.0, 0.25], [0.5, 0.0], [0.0, 0.0]]).double()
    upper, lower = (torch.special.log_ndtr((sign * widths / 2 - x.abs()) / scale) for sign in (1, -1))
    exact = (upper + torch.log1p(-(lower - upper).exp())).sum()  # in the left tail, where differences are exact
    many = Batch(x=x.expand(4000, 3, 2), c=torch.zeros(4000, 3, 1).double())
    torch.manual_seed(0)
    bounds = constant_model(scale, Dequantised(WIDTHS)).log_joint(many, {})["x"] + 3 * widths.log().sum()
    assert bounds.mean() <= exact + 3 * bounds.std() / 4000**0.5
    zeros = Batch(x=torch.zeros(1, 3, 2).double(), c=many["c"][:1])
    without_noise = constant_model(scale).log_joint(zeros, {})["x"] + 3 * widths.log().sum()
    if scale == 2.0:
        torch.testing.assert_close(bounds.mean(), exact, rtol=0.01, atol=0)
    if scale < 0.1:
        assert without_noise > 0  # no probability is that large
