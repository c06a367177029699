"""Control: motions bent to given paths, by the most likely move of their latents and correction of their poses.

A motion is what the decoder f makes of latents, and a correction e of its poses, x = f(z_k + s m) + e: m moves the
latents from a draw z_k, in units of their prior's scale s, and every coordinate of e is a Gaussian process over frames
that starts at 0 in the first pose. Minimised is

    |m|^2 + e' K^-1 e / c^2 + |bone lengths / first - 1|^2 / stretch^2        where x is on the paths, exactly

which is the mode of a posterior whose prior is centred at each draw, so that draws stay different. On the paths e is
what the decoder misses, and between them it goes over smoothly; elsewhere it is free, for the bones to share. So e is
how far the motion is from what the model can make. TrajeVAE (Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351)
names it as a limitation that given joints miss their paths; bending is ours.
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
"""Standard deviation of a bone's length, relative."""
CORRECTION = 0.01
"""c, metres, standard deviation of corrections."""
SMOOTH = 5.0
"""Frames over which corrections change."""
ENOUGH = 0.01
"""Change of the minimised sum in a step below which it is the last."""


def bend(
    decode: Callable[[Tensor], Tensor],
    latents: Tensor,
    scale: Tensor,
    paths: Tensor,
    known: Tensor,
    skeleton: Skeleton,
    bones: Tensor,
    *,
    steps: int = 400,
    progress: bool = False,
) -> tuple[Tensor, Tensor]:
    """Motions that follow the paths, each by L-BFGS.

    (Longer than other functions by what its arguments mean.)

    Args:
        decode: motions (1, T, D) in metres of latents (1, ...).
        latents: (S, ...), where to start from.
        scale: of the latents, positive; broadcasts against one motion's.
        paths: (T, D).
        known: (T, D) 1 where the path is known, and else 0.
        skeleton: of the poses.
        bones: (J - 1,) lengths to keep, in metres; those without length are free.
        steps: of the optimiser, at most, for each motion.
        progress: whether to show a progress bar.

    Returns:
        The motions (S, T, D), and their corrections (S, T, D) in metres.

    Raises:
        ValueError: no steps.
    """
    if steps < 1:
        raise ValueError(f"steps is at least 1, got {steps}")
    covariance = smooth_covariance(len(known))
    root = CORRECTION * torch.linalg.cholesky(covariance)
    root, white, gain = (each.to(latents) for each in (root, torch.linalg.inv(root), gains(covariance, known)))
    kept = bones > SHORTEST

    def bent(z: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            moves = torch.zeros_like(z), torch.zeros_like(decode(z))
        for each in moves:
            each.requires_grad_()

        def motion() -> tuple[Tensor, Tensor]:
            made, free = decode(z + scale * moves[0]), root @ moves[1]
            correction = free + torch.einsum("dts,...sd->...td", gain, paths - made - free)
            return made + correction, correction

        def loss() -> Tensor:
            x, correction = motion()
            stretched = skeleton.limbs(x)[..., kept, :].norm(dim=-1) / bones[kept] - 1
            residuals = moves[0], white @ correction, stretched / STRETCH
            total = torch.stack([each.square().sum() for each in residuals]).sum()
            for each, gradient in zip(moves, torch.autograd.grad(total, moves), strict=True):
                each.grad = gradient
            return total.detach()

        optimiser = torch.optim.LBFGS(
            moves, max_iter=steps, history_size=50, tolerance_change=ENOUGH, line_search_fn="strong_wolfe"
        )
        with torch.enable_grad():
            optimiser.step(loss)
        with torch.no_grad():
            return motion()

    with progress_bar(progress) as bar:
        found = [bent(z) for z in bar.track(latents.split(1), description="following the paths")]
    motions, corrections = zip(*found, strict=True)
    return torch.cat(motions), torch.cat(corrections)


def smooth_covariance(frames: int) -> Tensor:
    """Covariance (T, T), over frames 1 to T, of a Matern process of order 3/2 and variance 1 that is 0 at frame 0."""
    frame = torch.arange(frames + 1, dtype=torch.float64)
    apart = sqrt(3) / SMOOTH * (frame[:, None] - frame).abs()
    whole = (1 + apart) * (-apart).exp()
    return whole[1:, 1:] - whole[1:, :1] * whole[:1, 1:]


def gains(covariance: Tensor, known: Tensor) -> Tensor:
    """(D, T, T) that take a process, whose values at known[:, d] alone count, to its mean given these."""
    found = covariance.new_zeros(known.shape[1], *covariance.shape)
    patterns, which = known.bool().cpu().unique(dim=1, return_inverse=True)
    for n, seen in enumerate(patterns.T):
        gain = torch.zeros_like(covariance)
        gain[:, seen] = torch.linalg.solve(covariance[seen][:, seen], covariance[seen]).T
        found[which == n] = gain
    return found
