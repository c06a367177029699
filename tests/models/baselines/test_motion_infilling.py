"""Motion Infilling: its size, that it draws nothing, what it reads and what is hidden of that in training."""

import math
from dataclasses import replace

import pytest
import torch

import dvae
from dvae import motion
from dvae.models.baselines.motion_infilling import HIDDEN
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


# ------------------------------------------------------------------------------------------------------- the method


class TestMotionInfilling(FactorizationContract):
    def build(self, size):
        return small().build({"x": size})

    @pytest.mark.skip(reason="the network outputs sequences of one length, and none is padded")
    def test_padding_changes_nothing(self):
        pass


def test_the_network_for_human36m_has_the_published_size():
    """That of the network for gaps of any width, in its record; no number of it depends on the skeleton."""
    for skeleton in (HUMAN36M, motion.Skeleton(("root", "knee", "foot"), (-1, 0, 1))):
        model = dvae.method("motion-infilling", maps=(32, 64, 128, 256, 256)).build_on(skeleton)
        assert sum(parameter.numel() for parameter in model.parameters()) == 4_703_425
    published = dvae.method("motion-infilling")
    assert published.with_presets(published.preset(HUMAN36M)).maps == (32, 64, 128, 256, 256)


@pytest.mark.parametrize("frames", [1, 11, 33])
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


# ----------------------------------------------------------------------------------------------------- what it makes


def test_nothing_of_joints_that_are_not_given_is_read(windows):
    """Nor of given ones while they are hidden; of the others everything."""
    model, batch = build(windows), some(windows)
    shown = (batch["y"] != 0).any(0).any(0)
    hidden = torch.full_like(batch["x"], torch.inf)
    hidden[:, 8:12] = 0.3
    x = batch["x"].requires_grad_()
    for curriculum, unseen in ((0.2, slice(0, 0)), (0.3, slice(7, 11))):
        data = {"x": x, "y": x * shown, HIDDEN: hidden}
        rollout = model.rollout(model.read(data, curriculum=curriculum))
        mean = rollout.parameters("x", x[:, 1:])[0]
        (slope,) = torch.autograd.grad(mean.sin().sum(), x)
        read = (slope != 0).any(0)
        assert read[0, 3:].all()  # the first pose, whose root is where all coordinates begin
        assert not read[1:, ~shown].any()
        known = torch.ones(20, dtype=torch.bool)
        known[unseen] = False
        assert not read[1:, shown][~known].any()
        assert read[1:, shown][known].all()


# ------------------------------------------------------------------------------------------- what is hidden of paths


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


def test_a_run_goes_through_its_curriculum(windows):
    recipe = small(curriculum=0.5).train(windows, windows, 8)
    fit = dvae.fit(small().build(windows), recipe, batch_size=4, log_every=1, validate_every=8, progress=False)
    assert fit.series("curriculum")[1] == [0, 0.25, 0.5, 0.75, 1, 1, 1, 1]
    assert fit.best_step == 8
