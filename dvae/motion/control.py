"""Control: make motions follow given paths of joints, by moving their latents and correcting their poses.

The decoder f turns latents into a motion, and e corrects its poses: x = f(z_k + s m) + e. The move m shifts the latents
from a draw z_k, in units of the prior's scale s. Every coordinate of e is a Gaussian process over frames that is 0 in
the first pose. With b the lengths of the bones and b_0 their target lengths, `follow_paths` minimises

    |m|^2 + e' K^-1 e / c^2 + |b / b_0 - 1|^2 / stretch^2

under the constraint that x is exactly on the paths where these are known. The minimum is the mode of a posterior whose
prior is centred at each draw, so different draws give different motions. Where a path is known, e is the error of the
decoder; between known frames, e is interpolated smoothly. The other joints may be corrected too, which helps to keep
the bone lengths. The size of e shows how far the motion is from the model.

TrajeVAE (Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351) names as a limitation that given joints miss their
paths. This correction is our own addition.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import torch
from torch import Tensor

from ..inference.evaluation.result import progress_bar
from . import Skeleton
from .geometry.skeleton import SHORTEST

STRETCH = 0.02
"""Relative standard deviation of bone lengths."""
CORRECTION = 0.01
"""Standard deviation c of the corrections in metres."""
SMOOTH = 5.0
"""Length scale of the corrections in frames."""
ENOUGH = 0.01
"""Smallest decrease of the minimised sum per step; the optimiser stops below it."""


def follow_paths(
    decode: Callable[[Tensor], Tensor],
    latents: Tensor,
    scale: Tensor,
    paths: Tensor,
    mask: Tensor,
    skeleton: Skeleton,
    bones: Tensor,
    *,
    steps: int = 400,
    progress: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return motions that follow the paths, each fitted by L-BFGS.

    Args:
        decode: function from latents (1, ...) to motions (1, T, D) in metres.
        latents: (S, ...) draws z_k, the starts of the fits of S motions.
        scale: positive scale s of the latents under the prior; broadcasts against the latents of one motion.
        paths: (T, D) joint positions to follow, in metres.
        mask: (T, D), 1 where a path is known and 0 where `paths` is ignored.
        skeleton: skeleton of the poses.
        bones: (J - 1,) target bone lengths in metres, in the order of `Skeleton.edges`; bones of length zero are
            unconstrained.
        steps: maximum number of optimiser steps for each motion.
        progress: whether to show a progress bar.

    Returns:
        The motions (S, T, D) and their corrections (S, T, D), both in metres.

    Raises:
        ValueError: `steps` is below 1.
    """
    if steps < 1:
        raise ValueError(f"`steps` must be at least 1, got {steps}")
    covariance = smooth_covariance(len(mask))
    root = CORRECTION * torch.linalg.cholesky(covariance)
    root, white, gain = (matrix.to(latents) for matrix in (root, torch.linalg.inv(root), gains(covariance, mask)))
    constrained = bones > SHORTEST

    def fit(z: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            moves = torch.zeros_like(z), torch.zeros_like(decode(z))
        for move in moves:
            move.requires_grad_()

        def motion() -> tuple[Tensor, Tensor]:
            decoded, free = decode(z + scale * moves[0]), root @ moves[1]
            correction = free + torch.einsum("dts,...sd->...td", gain, paths - decoded - free)
            return decoded + correction, correction

        def loss() -> Tensor:
            x, correction = motion()
            stretched = skeleton.limbs(x)[..., constrained, :].norm(dim=-1) / bones[constrained] - 1
            residuals = moves[0], white @ correction, stretched / STRETCH
            total = torch.stack([residual.square().sum() for residual in residuals]).sum()
            for move, gradient in zip(moves, torch.autograd.grad(total, moves), strict=True):
                move.grad = gradient
            return total.detach()

        optimiser = torch.optim.LBFGS(
            moves, max_iter=steps, history_size=50, tolerance_change=ENOUGH, line_search_fn="strong_wolfe"
        )
        with torch.enable_grad():
            optimiser.step(loss)
        with torch.no_grad():
            return motion()

    with progress_bar(progress) as bar:
        fits = [fit(z) for z in bar.track(latents.split(1), description="following the paths")]
    motions, corrections = zip(*fits, strict=True)
    return torch.cat(motions), torch.cat(corrections)


def smooth_covariance(frames: int) -> Tensor:
    """Return the covariance (T, T) of a Matern-3/2 process over frames 1 to T, given the value 0 at frame 0.

    The process has variance 1 before conditioning, and the length scale `SMOOTH`.

    Args:
        frames: T, number of frames.
    """
    frame = torch.arange(frames + 1, dtype=torch.float64)
    distance = sqrt(3) / SMOOTH * (frame[:, None] - frame).abs()
    kernel = (1 + distance) * (-distance).exp()
    return kernel[1:, 1:] - kernel[1:, :1] * kernel[:1, 1:]


def gains(covariance: Tensor, mask: Tensor) -> Tensor:
    """Return (D, T, T) matrices that map a process to its conditional mean.

    The mean of coordinate d is conditioned on its values at the frames with mask[:, d] = 1; its values at all other
    frames are ignored.

    Args:
        covariance: (T, T) covariance of the process over frames.
        mask: (T, D), 1 where a coordinate is known and 0 elsewhere.
    """
    matrices = covariance.new_zeros(mask.shape[1], *covariance.shape)
    patterns, pattern = mask.bool().cpu().unique(dim=1, return_inverse=True)
    for n, observed in enumerate(patterns.T):
        gain = torch.zeros_like(covariance)
        gain[:, observed] = torch.linalg.solve(covariance[observed][:, observed], covariance[observed]).T
        matrices[pattern == n] = gain
    return matrices
