"""Motion Infilling: its size, its deterministic output, its inputs and the inputs hidden in training."""

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


def some_batch(windows, count=3):
    return {name: value[:count] for name, value in double(windows.given(["LWrist", "RFoot"]).all()).items()}


# ------------------------------------------------------------------------------------------------------- the method


class TestMotionInfilling(FactorizationContract):
    def build(self, size):
        return small().build({"x": size})

    @pytest.mark.skip(reason="the network outputs sequences of one length, and none is padded")
    def test_padding_changes_nothing(self):
        pass


def test_the_network_for_human36m_has_the_published_size():
    """The size is in the record of the network for gaps of any width, and does not depend on the skeleton."""
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


def test_the_loss_is_the_absolute_error_plus_a_constant(windows):
    model, batch = build(windows), some_batch(windows)
    terms = dvae.SequenceELBO().terms(model, batch)
    mean = model.reconstruct(batch)["x"][0]
    errors = (batch["x"][:, 1:] - mean[:, -20:]).abs().sum((1, 2))
    assert not terms.kl
    torch.testing.assert_close(-terms.bound, errors + 20 * windows.size * math.log(2))
    torch.testing.assert_close(small().train(windows).objective(terms, 0), -terms.bound.sum() / (3 * 20))


# ------------------------------------------------------------------------------------------------------- inputs


def test_joints_that_are_not_given_are_not_read(windows):
    """Given joints are read entirely, except while hidden."""
    model, batch = build(windows), some_batch(windows)
    is_given = (batch["y"] != 0).any(0).any(0)
    hidden = torch.full_like(batch["x"], torch.inf)
    hidden[:, 8:12] = 0.3
    x = batch["x"].requires_grad_()
    for curriculum, hidden_frames in ((0.2, slice(0, 0)), (0.3, slice(7, 11))):
        data = {"x": x, "y": x * is_given, HIDDEN: hidden}
        rollout = model.rollout(model.read(data, curriculum=curriculum))
        mean = rollout.parameters("x", x[:, 1:])[0]
        (slope,) = torch.autograd.grad(mean.sin().sum(), x)
        is_read = (slope != 0).any(0)
        assert is_read[0, 3:].all()  # the first pose, whose root is the origin
        assert not is_read[1:, ~is_given].any()
        is_visible = torch.ones(20, dtype=torch.bool)
        is_visible[hidden_frames] = False
        assert not is_read[1:, is_given][~is_visible].any()
        assert is_read[1:, is_given][is_visible].all()


# ---------------------------------------------------------------------------------------- hidden parts of paths


def test_hidden_parts_of_paths_are_not_read(windows):
    model = build(windows)
    batch = double(small().train(windows).batches.sample(5, torch.Generator().manual_seed(0)))
    for curriculum in (0.0, 0.5, 1.0):
        batch_read = model.read(batch, curriculum=curriculum)
        assert torch.equal(batch_read["y"], torch.where(batch[HIDDEN] <= curriculum, 0.0, batch["x"])[:, 1:])
        assert torch.equal(batch_read["x"], batch["x"][:, 1:])
        assert HIDDEN not in batch_read
        bound = dvae.SequenceELBO().terms(model, batch, curriculum=curriculum).bound
        torch.testing.assert_close(bound, dvae.SequenceELBO().terms(model, {n: batch_read[n] for n in "sxy"}).bound)


def test_a_fit_follows_its_curriculum(windows):
    recipe = small(curriculum=0.5).train(windows, windows, 8)
    fit = dvae.fit(small().build(windows), recipe, batch_size=4, log_every=1, validate_every=8, progress=False)
    assert fit.series("curriculum")[1] == [0, 0.25, 0.5, 0.75, 1, 1, 1, 1]
    assert fit.best_step == 8
