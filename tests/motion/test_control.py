"""Bending motion to paths: against the closed form where decoder and bones are linear, and by what corrections are."""

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
    """Without bones that matter, the mean of a Gaussian that knows some of its values, around each draw."""
    steps, size, latent = 4, 6, 3
    weight, drawn, paths = double(steps * size, latent), double(2, latent), double(steps, size)
    scale = torch.rand(latent, dtype=torch.float64) + 0.5
    known = torch.zeros(steps, size, dtype=torch.float64)
    known[:, 0], known[1, 3:] = 1, 1

    found, corrections = follow_paths(
        lambda z: (z @ weight.T).unflatten(-1, (steps, size)), drawn, scale, paths, known, POINT, LOOSE
    )
    correction = control.CORRECTION**2 * torch.kron(smooth_covariance(steps), torch.eye(size, dtype=torch.float64))
    covariance = (weight * scale.square()) @ weight.T + correction
    rows = known.flatten().bool()
    gain = torch.linalg.solve(covariance[rows][:, rows], covariance[rows]).T
    for z, motion, corrected in zip(drawn, found, corrections, strict=True):
        missing = paths.flatten()[rows] - weight[rows] @ z
        torch.testing.assert_close(motion.flatten(), weight @ z + gain @ missing, atol=1e-5, rtol=0)
        share = correction[:, rows] @ torch.linalg.solve(covariance[rows][:, rows], missing)
        torch.testing.assert_close(corrected.flatten(), share, atol=1e-5, rtol=0)
        torch.testing.assert_close(motion[known.bool()], paths[known.bool()], atol=1e-12, rtol=0)


@pytest.mark.usefixtures("to_the_end")
def test_bones_are_kept_where_the_path_leaves_the_choice():
    """One joint is given; the other may lie anywhere on a sphere around it, and stays near where it was."""
    drawn = torch.tensor([[0.0, 0.0, 0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
    known = torch.tensor([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    paths = torch.tensor([[0.0, 0.6, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    one, bones = torch.ones(6, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    found = follow_paths(lambda z: z[:, None], drawn, one, paths, known, POINT, bones)[0][0, 0]
    assert torch.allclose(found[:3], paths[0, :3])
    assert abs((found[3:] - found[:3]).norm() - 1) < 0.01
    assert torch.allclose(found[3::2], torch.zeros(2, dtype=torch.float64), atol=1e-3)
    unmoved, corrections = follow_paths(lambda z: z[:, None], drawn, one, paths, 0 * known, POINT, bones)
    assert torch.allclose(unmoved[:, 0], drawn)
    assert torch.allclose(corrections, torch.zeros(()).double())


def test_corrections_come_and_go():
    """A decoder that nothing moves: around a known frame the correction is a bump, and 0 in the first pose."""
    known = torch.zeros(30, 6, dtype=torch.float64)
    known[14, 3:] = 1
    paths = torch.full((30, 6), 0.3, dtype=torch.float64)
    still, one = torch.zeros(1, 30, 6, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    made, corrections = follow_paths(lambda z: still, double(1, 2), one, paths, known, POINT, LOOSE)
    tip = corrections[0, :, 3]
    assert torch.equal(made, corrections)
    assert tip[14] == pytest.approx(0.3)
    assert (corrections[..., :3].abs() < 1e-6).all()
    assert (tip.diff()[:14] > 0).all()
    assert (tip.diff()[14:] < 0).all()
    assert tip.diff().abs().max() < 0.05
    assert tip[0] < 0.005
