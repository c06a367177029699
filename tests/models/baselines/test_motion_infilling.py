"""Motion Infilling: its size, that it draws nothing, what it reads and what is hidden of that in training."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.stats import binomtest, norm

import dvae
from dvae import motion
from dvae.models.baselines.motion_infilling import HIDDEN, IN_TIME, JOINTS, NARROWEST, SPREAD, Gaps, start
from dvae.motion import HUMAN36M, PROTOCOLS
from dvae.testing import FactorizationContract

PROTOCOL = replace(
    PROTOCOLS["bandai2-trajectories"], name="walks", split_by="split", train=("train",), test=("test",), predicted=20
)


@pytest.fixture(scope="module")
def people():
    return motion.simulate(clips=10, frames=50, test=0.3)


@pytest.fixture(scope="module")
def windows(people):
    return motion.windows(people, PROTOCOL, "train")


def small(**options):
    return dvae.method("motion-infilling", **{"maps": (4, 6), "heading": False, **options})


def build(windows, **options):
    torch.manual_seed(0)
    return small(**options).build(windows).double().eval()


def double(batch):
    return {name: value.double() for name, value in batch.items()}


def some(windows, count=3):
    return {name: value[:count] for name, value in double(windows.given(["LWrist", "RFoot"]).all()).items()}


def walk(windows):
    """A pose, and the way of a wrist from there."""
    positions = windows.positions(windows.all()["x"][0]).numpy()
    return positions[0], {"LWrist": positions[1:, windows.skeleton.find("LWrist")]}


# ------------------------------------------------------------------------------------------------------- the method


class TestMotionInfilling(FactorizationContract):
    def build(self, size):
        return small().build({"x": size})

    @pytest.mark.skip(reason="the network makes sequences of one length, and none is padded")
    def test_padding_changes_nothing(self):
        pass


def test_the_network_for_human36m_has_the_published_size():
    """That of the network for gaps of any width, in its record; no number of it depends on the skeleton."""
    for skeleton in (HUMAN36M, motion.Skeleton(("root", "knee", "foot"), (-1, 0, 1))):
        model = dvae.method("motion-infilling", maps=(32, 64, 128, 256, 256)).build_on(skeleton)
        assert sum(parameter.numel() for parameter in model.parameters()) == 4_703_425
    published = dvae.method("motion-infilling")
    assert published.filled(published.preset(HUMAN36M)).maps == (32, 64, 128, 256, 256)


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 11, 32, 33])
def test_motions_have_any_length_and_bodies_any_size(frames):
    for joints in (2, 3, 5):
        chain = motion.Skeleton(tuple(map(str, range(joints))), tuple(range(-1, joints - 1)))
        model = small(maps=(2, 3, 2, 2)).build_on(chain, frames)
        batch = {"s": torch.randn(2, 3 * joints), "y": torch.randn(2, frames, 3 * joints)}
        out = model.forecast(batch, frames, 2)["x"]
        assert out.shape == (2, 2, frames, 3 * joints)
        assert out.isfinite().all()


def test_minus_the_log_density_is_the_absolute_error_and_a_constant(windows):
    model, batch = build(windows), some(windows)
    terms = dvae.SequenceELBO().terms(model, batch)
    made = model.reconstruct(batch)["x"][0]
    errors = (batch["x"][:, 1:] - made[:, -20:]).abs().sum((1, 2))
    assert not terms.kl
    torch.testing.assert_close(-terms.bound, errors + 20 * windows.size * math.log(2))
    torch.testing.assert_close(small().train(windows).objective(terms, 0), -terms.bound.sum() / (3 * 20))


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda: small(maps=()), "maps is empty; the image has at least one size"),
        (lambda: small(beta=0.1), "motion-infilling has no option 'beta'"),
        (lambda: small(latent=3), "latent"),
        (lambda: small(gap=1.5), "gap is 1.5; it must be between 0 and 1"),
    ],
)
def test_options_that_cannot_be(run, message):
    with pytest.raises((TypeError, ValueError), match=message):
        run()


# ----------------------------------------------------------------------------------------------------- what it makes


def test_given_pose_and_paths_there_is_one_motion(windows):
    model, batch = build(windows), some(windows)
    past = {"x": batch["x"][:, :1], "y": batch["y"]}
    many = model.forecast(past, 20, 7, temperature=2.0)["x"]
    assert torch.equal(many, model.forecast(past, 20)["x"].expand_as(many))
    done = model.complete(*walk(windows), samples=3)
    assert (done.positions == done.positions[0]).all()


def test_the_best_of_many_is_the_one_motion_and_the_table_says_so(people):
    test = motion.windows(people, PROTOCOL, "test").given(["LWrist"])
    model = build(test).float()
    one, many = (
        dvae.evaluate(model, test, scores=motion.scores, samples=samples, references=False, progress=False)
        for samples in (1, 5)
    )
    assert many["model"]["APD"].mean == 0
    for name in ("ADE", "FDE", "ADEm", "MMADE", "energy score", "path error"):
        assert many["model"][name].mean == pytest.approx(one["model"][name].mean, rel=1e-5), name
    said = "model draws nothing: its 5 forecasts of a window are one, which is the best of them"
    assert said in many.notes
    assert said not in one.notes
    assert many.emission == "mean"


def test_nothing_of_joints_that_are_not_given_is_read(windows):
    """Nor of given ones while they are hidden; of the others everything."""
    model, batch = build(windows), some(windows)
    shown = (batch["y"] != 0).any(0).any(0)
    hidden = torch.full_like(batch["x"], torch.inf)
    hidden[:, 8:12] = 0.3
    x = batch["x"].requires_grad_()
    for curriculum, unseen in ((0.2, slice(0, 0)), (0.3, slice(7, 11))):
        data = {"x": x, "y": x * shown, HIDDEN: hidden}
        rollout = model._rollout(model.generative, model.generator, model.read(data, curriculum=curriculum), None, 1)
        mean = rollout.parameters("x", x[:, 1:])[0]
        (slope,) = torch.autograd.grad(mean.sin().sum(), x)
        read = (slope != 0).any(0)
        assert read[0, 3:].all()  # the first pose, whose root is where all coordinates begin
        assert not read[1:, ~shown].any()
        known = torch.ones(20, dtype=torch.bool)
        known[unseen] = False
        assert not read[1:, shown][~known].any()
        assert read[1:, shown][known].all()


def test_windows_that_are_turned_have_turned_motions(windows):
    model, angle, batch = build(windows, heading=True), torch.tensor(2.0, dtype=torch.float64), some(windows)

    def turn(values):
        return motion.rotate_about_up(values.unflatten(-1, (-1, 3)), angle, windows.skeleton.up).flatten(-2)

    past = {"x": batch["x"][:, :1], "y": batch["y"]}
    ours = model.forecast(past, 20)["x"]
    torch.testing.assert_close(model.forecast({name: turn(v) for name, v in past.items()}, 20)["x"], turn(ours))


def test_exact_paths_need_latents(windows):
    with pytest.raises(ValueError, match="a move of their latents, of which motion-infilling has none"):
        build(windows).complete(*walk(windows), exact=True)


def test_a_network_that_makes_nothing_makes_the_mean_of_what_it_is_to_learn(windows):
    model = small(heading=True).build(windows).eval()
    torch.manual_seed(0)
    start(model, windows)
    with torch.no_grad():
        for parameter in model.generator["x"].network.up[0].parameters():
            parameter.zero_()
    torch.manual_seed(0)
    seen = model.read(windows.sample(1024, torch.default_generator))
    made = model({name: seen[name][:2] for name in "sy"}, length=20, mean_emission=True)["x"]
    torch.testing.assert_close(made[0, 5], seen["x"].double().mean((0, 1)).float())


# ------------------------------------------------------------------------------------------- what is hidden of paths


@pytest.fixture(scope="module")
def hidden(windows):
    """From when on frames (N, T) are hidden in gaps, and joints (M, J) elsewhere."""
    batch = Gaps(windows.given(1.0), 0.5).sample(6_000, torch.Generator().manual_seed(0))
    levels = batch[HIDDEN].unflatten(-1, (-1, 3))
    assert torch.equal(levels, levels[..., :1].expand_as(levels))
    levels = levels[..., 0]
    in_time = (levels == levels[..., :1]).all(-1).all(-1)
    return levels[in_time, :, 0], levels[~in_time]


def test_windows_have_a_gap_in_time_or_lack_joints(hidden):
    gaps, others = map(len, hidden)
    assert binomtest(gaps, gaps + others, IN_TIME).pvalue > 0.001


@pytest.mark.parametrize("curriculum", [0.0, 0.4, 1.0])
def test_gaps_are_as_wide_as_the_curriculum_says_and_anywhere(hidden, curriculum):
    """Frames are hidden in one run, so many as a normal says that is cut at nothing and at the whole window."""
    gaps = hidden[0] <= curriculum
    assert ((gaps[:, 1:] & ~gaps[:, :-1]).sum(1) + gaps[:, 0] <= 1).all()
    length = gaps.shape[1]
    mean, deviation = 0.5 * (NARROWEST + (1 - NARROWEST) * curriculum), 0.5 * SPREAD
    ends = [(end - mean) / deviation for end in (0.0, 1.0)]
    inside = norm.cdf(ends[1]) - norm.cdf(ends[0])
    width = mean * inside + deviation * (norm.pdf(ends[0]) - norm.pdf(ends[1])) + norm.sf(ends[1])
    count = gaps.double().sum(1)
    assert abs(count.mean() - width * length) < 5 * count.std() / len(gaps) ** 0.5
    centres = (gaps * (torch.arange(length) + 0.5)).sum(1)[count > 0] / count[count > 0]
    assert abs(centres.mean() - length / 2) < 5 * centres.std() / len(centres) ** 0.5
    assert gaps.any(0).all()


@pytest.mark.parametrize(("curriculum", "joints"), [(0.0, 1), (0.3, 1), (0.4, 2), (0.7, 3), (1.0, JOINTS)])
def test_more_and_more_joints_are_taken_and_never_the_root(hidden, windows, curriculum, joints):
    taken = hidden[1] <= curriculum
    assert (taken == taken[:, :1]).all()
    assert (taken[:, 0].sum(1) == joints).all()
    often = taken[:, 0].sum(0)
    assert often[windows.skeleton.root] == 0
    others = often[torch.arange(len(often)) != windows.skeleton.root].tolist()
    assert all(binomtest(n, len(taken), joints / len(others)).pvalue > 1e-4 for n in others)


def test_a_batch_is_read_without_what_is_hidden(windows):
    model = build(windows)
    batch = double(small().train(windows).batches.sample(5, torch.Generator().manual_seed(0)))
    for curriculum in (0.0, 0.5, 1.0):
        seen = model.read(batch, curriculum=curriculum)
        assert torch.equal(seen["y"], torch.where(batch[HIDDEN] <= curriculum, 0.0, batch["x"])[:, 1:])
        assert torch.equal(seen["x"], batch["x"][:, 1:])
        assert HIDDEN not in seen
        narrow = dvae.SequenceELBO().terms(model, batch, curriculum=curriculum).bound
        torch.testing.assert_close(narrow, dvae.SequenceELBO().terms(model, {n: seen[n] for n in "sxy"}).bound)


def test_the_curriculum_rises_over_its_share_of_training(windows):
    recipe = small(curriculum=0.5).train(windows, windows, 100)
    assert [recipe.stages[0].curriculum(step) for step in (0, 5, 30, 55, 99)] == pytest.approx([0, 0, 0.5, 1, 1])
    assert small(curriculum=1.0).train(windows, None, 100).stages[0].curriculum(100) == 1
    assert small(curriculum=0.0).train(windows, None, 100).stages[0].curriculum is None
    assert (recipe.validation.all()[HIDDEN] <= 1).any()
    assert torch.equal(recipe.validation.all()[HIDDEN], recipe.validation.all()[HIDDEN])
    for steps in (1, 2, 3):
        assert small().train(windows, None, steps).stages[0].curriculum is not None


def test_without_gaps_training_is_that_of_the_neighbours(windows):
    ours, theirs = (method.train(windows).batches for method in (small(gap=0.0, keep=0.15), dvae.method("trajevae")))
    drawn = [batches.sample(4, torch.Generator().manual_seed(0)) for batches in (ours, theirs)]
    assert drawn[0].keys() == drawn[1].keys()
    assert all(torch.equal(drawn[0][name], drawn[1][name]) for name in drawn[0])
    assert small(gap=0.0).train(windows).stages[0].curriculum is None


def test_a_run_goes_through_its_curriculum(windows):
    recipe = small(curriculum=0.5).train(windows, windows, 8)
    fit = recipe.fit(small().build(windows), batch_size=4, log_every=1, validate_every=8, progress=False)
    assert fit.series("curriculum")[1] == [0, 0.25, 0.5, 0.75, 1, 1, 1, 1]
    assert fit.best_step == 8


def test_a_curriculum_is_refused_where_nothing_comes_by_it():
    model = dvae.method("vae", latent=2).build({"x": 3})
    with pytest.raises(ValueError, match="has a curriculum, by which nothing of DynamicalVAE comes"):
        dvae.SVI(model, stages=[dvae.Stage(2, curriculum=0.5)])
