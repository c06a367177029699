"""Motion that follows paths: equal to the closed form for linear decoders, and smooth corrections."""

import pytest
import torch

from dvae.motion import Skeleton, control
from dvae.motion.control import follow_paths, smooth_covariance

POINT = Skeleton(("root", "tip"), (-1, 0))
LOOSE = torch.full((1,), 1e9, dtype=torch.float64)
"""Length of a bone for which any other is as good."""


def double(*shape):
    return torch.randn(*shape, dtype=torch.float64)


@pytest.fixture
def to_the_end(monkeypatch):
    monkeypatch.setattr(control, "ENOUGH", 1e-14)


@pytest.mark.usefixtures("to_the_end")
def test_a_linear_decoder_has_a_closed_form():
    """Without bones, the result is the conditional mean of a Gaussian around each draw."""
    steps, size, latent = 4, 6, 3
    weight, latents, paths = double(steps * size, latent), double(2, latent), double(steps, size)
    scale = torch.rand(latent, dtype=torch.float64) + 0.5
    mask = torch.zeros(steps, size, dtype=torch.float64)
    mask[:, 0], mask[1, 3:] = 1, 1

    motions, corrections = follow_paths(
        lambda z: (z @ weight.T).unflatten(-1, (steps, size)), latents, scale, paths, mask, POINT, LOOSE
    )
    correction = control.CORRECTION**2 * torch.kron(smooth_covariance(steps), torch.eye(size, dtype=torch.float64))
    covariance = (weight * scale.square()) @ weight.T + correction
    rows = mask.flatten().bool()
    gain = torch.linalg.solve(covariance[rows][:, rows], covariance[rows]).T
    for z, motion, corrected in zip(latents, motions, corrections, strict=True):
        missing = paths.flatten()[rows] - weight[rows] @ z
        torch.testing.assert_close(motion.flatten(), weight @ z + gain @ missing, atol=1e-5, rtol=0)
        share = correction[:, rows] @ torch.linalg.solve(covariance[rows][:, rows], missing)
        torch.testing.assert_close(corrected.flatten(), share, atol=1e-5, rtol=0)
        torch.testing.assert_close(motion[mask.bool()], paths[mask.bool()], atol=1e-12, rtol=0)


@pytest.mark.usefixtures("to_the_end")
def test_bone_lengths_are_kept_if_the_path_allows_it():
    """One joint is given; the other may lie on a sphere around it and stays near its position."""
    latents = torch.tensor([[0.0, 0.0, 0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
    mask = torch.tensor([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    paths = torch.tensor([[0.0, 0.6, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    one, bones = torch.ones(6, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    motion = follow_paths(lambda z: z[:, None], latents, one, paths, mask, POINT, bones)[0][0, 0]
    assert torch.allclose(motion[:3], paths[0, :3])
    assert abs((motion[3:] - motion[:3]).norm() - 1) < 0.01
    assert torch.allclose(motion[3::2], torch.zeros(2, dtype=torch.float64), atol=1e-3)
    unmoved, corrections = follow_paths(lambda z: z[:, None], latents, one, paths, 0 * mask, POINT, bones)
    assert torch.allclose(unmoved[:, 0], latents)
    assert torch.allclose(corrections, torch.zeros(()).double())


def test_corrections_rise_and_fall_smoothly():
    """For a constant decoder, the correction is a bump around the known frame and 0 in the first pose."""
    mask = torch.zeros(30, 6, dtype=torch.float64)
    mask[14, 3:] = 1
    paths = torch.full((30, 6), 0.3, dtype=torch.float64)
    still, one = torch.zeros(1, 30, 6, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    motion, corrections = follow_paths(lambda z: still, double(1, 2), one, paths, mask, POINT, LOOSE)
    tip = corrections[0, :, 3]
    assert torch.equal(motion, corrections)
    assert tip[14] == pytest.approx(0.3)
    assert (corrections[..., :3].abs() < 1e-6).all()
    assert (tip.diff()[:14] > 0).all()
    assert (tip.diff()[14:] < 0).all()
    assert tip.diff().abs().max() < 0.05
    assert tip[0] < 0.005
