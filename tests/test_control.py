"""Bending motion to paths: against the closed form where decoder and bones are linear."""

import torch

from dvae.inference.control import bend
from dvae.motion import Skeleton

POINT = Skeleton(("root", "tip"), (-1, 0))


def test_a_linear_decoder_has_a_closed_form():
    """Without bones that matter, the mode of a linear Gaussian posterior around each draw; corrections or not."""
    steps, size, latent = 3, 6, 4
    weight = torch.randn(steps * size, latent, dtype=torch.float64)
    drawn = torch.randn(2, latent, dtype=torch.float64)
    scale = torch.rand(latent, dtype=torch.float64) + 0.5
    paths = torch.randn(steps, size, dtype=torch.float64)
    known = torch.zeros(steps, size, dtype=torch.float64)
    known[:, 0], known[1, 3:] = 1, 1
    tolerance = 0.1
    bones = torch.full((1,), 1e9, dtype=torch.float64)  # any length is as good

    def decode(z):
        return (z @ weight.T).unflatten(-1, (steps, size))

    rows = known.flatten().bool()
    for correction in (0.0, 0.3):
        options = {"tolerance": tolerance, "correction": correction}
        found, corrections = bend(decode, drawn, scale, paths, known, POINT, bones, **options)
        spread = [weight * scale, correction * torch.eye(steps * size, dtype=torch.float64)]
        whole = torch.cat(spread, dim=1)
        seen = whole[rows]
        precision = seen.T @ seen / tolerance**2 + torch.eye(whole.shape[1], dtype=torch.float64)
        for z, motion, corrected in zip(drawn, found, corrections, strict=True):
            missing = paths.flatten()[rows] - weight[rows] @ z
            move = torch.linalg.solve(precision, seen.T @ missing / tolerance**2)
            torch.testing.assert_close(motion.flatten(), weight @ z + whole @ move, atol=1e-4, rtol=0)
            torch.testing.assert_close(corrected.flatten(), spread[1] @ move[latent:], atol=1e-4, rtol=0)


def test_bones_are_kept_where_the_path_leaves_the_choice():
    """One joint is given; the other may lie anywhere on a sphere around it, and stays near where it was."""
    drawn = torch.tensor([[0.0, 0.0, 0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
    known = torch.tensor([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    paths = torch.tensor([[0.0, 0.6, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    one = torch.ones(6, dtype=torch.float64)
    bones = torch.ones(1, dtype=torch.float64)
    found = bend(lambda z: z[:, None], drawn, one, paths, known, POINT, bones, tolerance=1e-3, correction=0.0)[0][0, 0]
    assert torch.allclose(found[:3], paths[0, :3], atol=2e-3)
    assert abs((found[3:] - found[:3]).norm() - 1) < 0.01
    assert torch.allclose(found[3::2], torch.zeros(2, dtype=torch.float64), atol=1e-3)
    unmoved, corrections = bend(lambda z: z[:, None], drawn, one, paths, 0 * known, POINT, bones)
    assert torch.allclose(unmoved[:, 0], drawn)
    assert torch.allclose(corrections, torch.zeros(()).double())
